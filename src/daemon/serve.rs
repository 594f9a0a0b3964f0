//! The service from start to stop.

use super::answer::{Inbox, answer_frames};
use super::attitude::Attitudes;
use super::health::{Health, Identity, summary};
use super::intake::Intake;
use super::publish::{Outbox, publish_answers};
use super::systemd::{Manager, watchdog_period};
use super::throttle::Throttle;
use super::{DaemonError, Equipment, equip};
use crate::bus::{self, BusError, FixMessage, Keys, State};
use crate::config::Settings;
use crate::track::{Guard, TrackFilter, Tracker};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tokio::time::{MissedTickBehavior, interval, timeout};
use zenoh::Wait;
use zenoh::bytes::Encoding;
use zenoh::qos::CongestionControl;

/// The longest the status loop sleeps.
const TURN: Duration = Duration::from_millis(250);
/// The status message's period.
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// How long publishing, and then closing the session, may take on the way out.
const FAREWELL: Duration = Duration::from_secs(2);

/// Runs the service until SIGTERM or SIGINT.
pub fn run(settings: Settings, onnxruntime: Option<&Path>) -> Result<(), DaemonError> {
    // Zenoh needs a multi-threaded runtime. Nothing here works long on it: inference and publishing have threads.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("nightfix")
        .enable_all()
        .build()
        .map_err(|source| DaemonError::System { action: "starting the runtime", source })?;
    let result = runtime.block_on(start_and_serve(settings, onnxruntime));
    // Not dropped: that would wait for a thread that is stuck, and the process would not end.
    runtime.shutdown_background();
    result
}

/// SIGTERM and SIGINT.
struct Signals {
    terminate: Signal,
    interrupt: Signal,
}

impl Signals {
    fn new() -> Result<Self, DaemonError> {
        let listen = |kind| signal(kind).map_err(|source| DaemonError::System { action: "listening for signals", source });
        Ok(Self { terminate: listen(SignalKind::terminate())?, interrupt: listen(SignalKind::interrupt())? })
    }
    async fn any(&mut self) -> &'static str {
        tokio::select! {
            _ = self.terminate.recv() => "SIGTERM",
            _ = self.interrupt.recv() => "SIGINT",
        }
    }
}

async fn start_and_serve(settings: Settings, onnxruntime: Option<&Path>) -> Result<(), DaemonError> {
    let mut signals = Signals::new()?;
    let mut manager = Manager::default();

    let (progress, mut progressed) = tokio::sync::mpsc::unbounded_channel::<String>();
    let for_equipment = (settings.clone(), onnxruntime.map(Path::to_owned));
    let mut equipping = tokio::task::spawn_blocking(move || {
        equip(&for_equipment.0, for_equipment.1.as_deref(), &|doing| {
            let _ = progress.send(doing.to_owned());
        })
    });
    let equipment = loop {
        tokio::select! {
            name = signals.any() => return stopped_early(&mut manager, name),
            Some(doing) = progressed.recv() => manager.status(&doing),
            done = &mut equipping => break done.map_err(|_| DaemonError::Ended { part: "start-up", why: "it panicked" })??,
        }
    };

    manager.status("opening Zenoh");
    // Twice the largest frame: what is a little too large is still seen, counted and answered; what is far too large is
    // not even put together.
    let max_message_bytes = settings.daemon.max_frame_bytes.saturating_mul(2).max(1 << 20);
    let mut opening = Box::pin(bus::open(&settings.zenoh, max_message_bytes));
    let session = loop {
        tokio::select! {
            name = signals.any() => return stopped_early(&mut manager, name),
            session = &mut opening => break session?,
            // A client waits here for its router, however long.
            () = tokio::time::sleep(Duration::from_secs(5)) => {
                manager.status("waiting for a Zenoh router");
                manager.extend(Duration::from_secs(30));
            }
        }
    };
    drop(opening);
    serve(settings, equipment, session, signals, manager).await
}

fn stopped_early(manager: &mut Manager, signal: &str) -> Result<(), DaemonError> {
    tracing::info!("{signal} before the start was done");
    manager.stopping("stopping");
    Ok(())
}

/// A thread of the service; its end is noticed, however it comes.
struct Worker {
    part: &'static str,
    ended: oneshot::Receiver<()>,
}

impl Worker {
    fn start(part: &'static str, work: impl FnOnce() + Send + 'static) -> Result<Self, DaemonError> {
        let (alive, ended) = oneshot::channel::<()>();
        std::thread::Builder::new()
            .name(part.to_owned())
            .spawn(move || {
                // Dropped with the thread's stack, also when it unwinds.
                let _alive = alive;
                work();
            })
            .map_err(|source| DaemonError::System { action: "starting a thread", source })?;
        Ok(Self { part, ended })
    }
    /// Waits for its end, at most so long; whether it came.
    async fn join(&mut self, wait: Duration) -> bool {
        timeout(wait, &mut self.ended).await.is_ok()
    }
}

async fn serve(
    settings: Settings,
    equipment: Equipment,
    session: zenoh::Session,
    mut signals: Signals,
    mut manager: Manager,
) -> Result<(), DaemonError> {
    let declaring = |what: &'static str| move |e: zenoh::Error| BusError::new(format!("declaring {what}"), e);
    let keys = Keys::new(&settings.vehicle.name);
    let deadline = Duration::from_millis(settings.daemon.deadline_ms);
    let search_budget = Duration::from_millis(settings.search.budget_ms).min(deadline);
    let Equipment { mut localizer, map, provider, .. } = equipment;
    let identity =
        Identity { vehicle: settings.vehicle.name.clone(), bundle: localizer.name(), map, provider: provider.name().to_owned() };
    let tracker = Tracker::new(settings.track.clone()).with_search_radius_m(localizer.largest().search_radius_m());
    let guard = Guard::new(settings.track.clone(), settings.gates.enabled);
    let health = Arc::new(Health::new(identity, deadline));
    let inbox = Arc::new(Inbox::new(tracker, Attitudes::new(settings.daemon.max_attitude_age_s)));
    let outbox = Arc::new(Outbox::new(&health));

    // Answers block for a peer that is slow, on their own thread; a status that cannot go out at once is stale soon.
    let fix = session
        .declare_publisher(keys.fix())
        .encoding(Encoding::APPLICATION_JSON)
        .congestion_control(CongestionControl::Block)
        .express(true)
        .await
        .map_err(declaring("the publisher of `fix`"))?;
    let status = session
        .declare_publisher(keys.status())
        .encoding(Encoding::APPLICATION_JSON)
        .congestion_control(CongestionControl::Drop)
        .await
        .map_err(declaring("the publisher of `status`"))?;

    let track = match settings.track.publish_track {
        false => None,
        true => {
            let track = session.declare_publisher(keys.track()).encoding(Encoding::APPLICATION_JSON);
            let track = track.congestion_control(CongestionControl::Drop).await;
            Some((track.map_err(declaring("the publisher of `track`"))?, TrackFilter::new(settings.track.clone())))
        }
    };

    let mut inference = {
        let (inbox, outbox, health, settings) = (inbox.clone(), outbox.clone(), health.clone(), settings.clone());
        Worker::start("inference", move || {
            answer_frames(&inbox, &outbox, &health, &settings, deadline, guard, |query| {
                let begun = Instant::now();
                localizer.locate_within(query, &|| begun.elapsed() < search_budget).0
            });
        })?
    };
    let mut publishing = {
        let (outbox, health) = (outbox.clone(), health.clone());
        Worker::start("publishing", move || {
            let mut track = track;
            let follow = |message: &FixMessage| {
                let Some((publisher, filter)) = &mut track else { return };
                let Some(bytes) = filter.take(message).and_then(|state| serde_json::to_vec(&state).ok()) else { return };
                if let Err(error) = publisher.put(bytes).wait() {
                    tracing::debug!("the track could not be published: {error}");
                }
            };
            publish_answers(&outbox, &health, |bytes| fix.put(bytes).wait().map_err(|e| e.to_string()), follow);
        })?
    };

    let _queryable = {
        let (outbox, key, failed) = (outbox.clone(), keys.fix(), Throttle::default());
        session
            .declare_queryable(keys.fix())
            .complete(true)
            .callback(move |query| {
                let answer = serde_json::to_vec(&outbox.last()).map_err(|e| e.to_string()).and_then(|bytes| {
                    query.reply(&key, bytes).encoding(Encoding::APPLICATION_JSON).wait().map_err(|e| e.to_string())
                });
                if let Err(why) = answer
                    && let Some(silent) = failed.open()
                {
                    tracing::warn!(silent, "a query could not be answered: {why}");
                }
            })
            .await
            .map_err(declaring("the queryable on `fix`"))?
    };
    let intake = Arc::new(Intake::new(inbox.clone(), health.clone(), settings.daemon.max_frame_bytes));
    let subscribers = [
        {
            let intake = intake.clone();
            session.declare_subscriber(keys.prior()).callback(move |sample| intake.prior(sample.payload())).await
        },
        {
            let intake = intake.clone();
            session.declare_subscriber(keys.attitude()).callback(move |sample| intake.attitude(sample.payload())).await
        },
        session.declare_subscriber(keys.frame()).callback(move |sample| intake.frame(&sample)).await,
    ];
    let subscribers = subscribers
        .into_iter()
        .collect::<Result<Vec<_>, _>>()
        .map_err(declaring("the subscribers of `frame`, `prior`, `attitude`"))?;
    // Last: who sees it can send.
    let alive = session.liveliness().declare_token(keys.alive()).await.map_err(declaring("the liveliness token"))?;

    manager.ready(&summary(&health.status()));
    tracing::info!(vehicle = %settings.vehicle.name, bundle = %health.identity().bundle, map = %health.identity().map.name, "ready");

    let mut last_status: Option<(State, Instant)> = None;
    let send_status = async |health: &Health| {
        if let Ok(bytes) = serde_json::to_vec(&health.status())
            && let Err(error) = status.put(bytes).await
        {
            tracing::debug!("the status could not be published: {error}");
        }
    };
    let watchdog = watchdog_period();
    let mut turn = interval(watchdog.unwrap_or(TURN).min(TURN));
    turn.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut pinged: Option<Instant> = None;
    let faults = Throttle::default();

    let ended = loop {
        tokio::select! {
            name = signals.any() => {
                tracing::info!("{name}: stopping");
                break None;
            }
            _ = &mut inference.ended => break Some(&inference),
            _ = &mut publishing.ended => break Some(&publishing),
            () = health.changed.notified() => {}
            _ = turn.tick() => {
                match health.fault(inbox.frames.oldest(|job| job.arrived)) {
                    None => {
                        if watchdog.is_some_and(|period| pinged.is_none_or(|at| at.elapsed() >= period)) {
                            manager.watchdog();
                            pinged = Some(Instant::now());
                        }
                    }
                    Some(fault) => {
                        if let Some(silent) = faults.open() {
                            tracing::error!(silent, "not well, the watchdog is not pinged: {fault}");
                        }
                    }
                }
                if session.is_closed() {
                    tracing::error!("the Zenoh session was closed");
                    return Err(DaemonError::Ended { part: "the Zenoh session", why: "it was closed" });
                }
            }
        }
        let state = health.state();
        if last_status.is_none_or(|(said, at)| said != state || at.elapsed() >= STATUS_PERIOD) {
            last_status = Some((state, Instant::now()));
            send_status(&health).await;
            manager.status(&summary(&health.status()));
        }
    };
    if let Some(worker) = ended {
        return Err(DaemonError::Ended { part: worker.part, why: "its thread panicked" });
    }

    // The way out: no longer alive to others, nothing more comes in, what is under way is answered and sent.
    health.stopping();
    manager.stopping(&summary(&health.status()));
    let undeclared = async {
        let _ = alive.undeclare().await;
        for subscriber in subscribers {
            let _ = subscriber.undeclare().await;
        }
    };
    let _ = timeout(FAREWELL, undeclared).await;
    inbox.frames.close();
    if !inference.join(deadline + FAREWELL).await {
        tracing::warn!("the last frame was not answered in time");
    }
    outbox.close();
    if !publishing.join(FAREWELL).await {
        tracing::warn!("the last answers were not sent in time");
    }
    let _ = timeout(FAREWELL, async {
        send_status(&health).await;
        session.close().await
    })
    .await;
    tracing::info!("stopped");
    Ok(())
}
