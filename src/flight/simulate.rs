//! Renders a recorded flight over a map: frames, poses with their errors, priors, truth.
//!
//! Beside the contract's files it writes `truth.csv`: per frame the true pose, the share of water under it, and the
//! homography from frame pixels to ground metres. Nothing of it is read by replay.

use super::classes;
use super::ground::Ground;
use super::night;
use super::noise::Dice;
use super::sensor::{Faults, Sensor, View, expose};
use super::trajectory::{Heading, Trajectory, Waypoint, lawnmower, line};
use super::world::{WorldOptions, make_world};
use crate::geo::{Affine, Crs, Enu};
use crate::map::{GeoTiff, WindowSpec, write_rgb};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// First exposure: 2026-01-15 20:00 UTC. Simulated flights have no clock.
const FIRST_STAMP_NS: i64 = 1_768_507_200_000_000_000;
/// Attempts to find a place for one frame.
const ATTEMPTS: usize = 20_000;
/// Where procedural worlds lie: EPSG code and the top-left corner, metres. Nominal.
const WORLD_PLACE: (u32, f64, f64) = (32640, 378_000.0, 2_802_000.0);

/// What the flight goes over.
#[derive(Debug, Clone, PartialEq)]
pub enum MapSource {
    /// A procedural world, written into the flight's folder.
    World(WorldOptions),
    /// A GeoTIFF, and where it has one its land-cover map (same grid).
    File {
        /// The map.
        map: PathBuf,
        /// Land cover; `<map>_classes.tif` beside the map is taken where this is absent.
        classes: Option<PathBuf>,
    },
}

/// What to render.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulateOptions {
    /// Over what.
    pub source: MapSource,
    /// The flight's folder.
    pub out: PathBuf,
    /// Frames.
    pub frames: usize,
    /// Seed of everything but the world.
    pub seed: u64,
    /// Priors lie uniformly in a disc of this radius about the truth, metres.
    pub radius_m: f64,
    /// A prior is written on every so-many-th row, from the first on.
    pub prior_every: usize,
    /// Reported yaw is off by up to this, uniform, degrees.
    pub yaw_noise_deg: f64,
    /// Reported height and metres per pixel are off by up to this share, uniform.
    pub scale_noise: f64,
    /// True pitch and roll, standard deviation, degrees.
    pub attitude_noise_deg: f64,
    /// Whether pitch and roll are reported (exactly); else the columns stay empty.
    pub report_attitude: bool,
    /// Kind of flight.
    pub trajectory: Trajectory,
    /// Image up.
    pub heading: Heading,
    /// Height above ground, metres.
    pub agl_m: f64,
    /// Ground speed, metres per second.
    pub speed_mps: f64,
    /// Distance between lanes, metres.
    pub lane_m: f64,
    /// The camera.
    pub sensor: Sensor,
    /// Largest side of the rendered area, metres; of a larger map a part is drawn from the seed.
    pub area_m: f64,
}

/// What was rendered.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct SimulateReport {
    /// Frames written.
    pub frames: usize,
    /// Frames of which more than 60 % is water.
    pub mostly_water: usize,
    /// Map file name.
    pub map: String,
    /// Whether land cover came from a file (else guessed from colour).
    pub classes: bool,
    /// Ground metres per frame pixel.
    pub gsd_m: f64,
}

/// What can go wrong.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// An option is out of range.
    #[error("simulate: {option}: expected {expected}, found {found}")]
    Option {
        /// Which.
        option: &'static str,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A file could not be written or read.
    #[error("simulate: `{path}`: {why}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        why: String,
    },
    /// The map cannot be read.
    #[error(transparent)]
    Map(#[from] crate::map::MapError),
    /// The map's place cannot be transformed.
    #[error(transparent)]
    Geo(#[from] crate::geo::GeoError),
    /// The footprint fits nowhere.
    #[error("simulate: frame {frame}: its footprint of {width_m:.0} x {height_m:.0} m lies nowhere whole on the map")]
    NoPlace {
        /// Frame number.
        frame: usize,
        /// Footprint width.
        width_m: f64,
        /// Footprint height.
        height_m: f64,
    },
}

/// Renders a flight. `progress(done, total)` is called after each frame.
pub fn simulate(options: &SimulateOptions, mut progress: impl FnMut(usize, usize)) -> Result<SimulateReport, SimulateError> {
    check(options)?;
    let file_error = |path: &Path| {
        let path = path.to_owned();
        move |e: std::io::Error| SimulateError::File { path, why: e.to_string() }
    };
    let frames_folder = options.out.join("frames");
    std::fs::create_dir_all(&frames_folder).map_err(file_error(&frames_folder))?;
    let ground = open(options)?;
    let night = night::render(&ground.scene, options.seed);

    let mut dice = Dice::new(options.seed, 200);
    let mut exposure = Dice::new(options.seed, 201);
    let mut faults = Faults::draw(&options.sensor, &mut exposure);
    let way = way(&ground, options, &mut dice)?;
    let mut poses = String::from(
        "file,stamp_ns,agl_m,gsd_m,yaw_deg,pitch_deg,roll_deg,prior_lat_deg,prior_lon_deg,prior_radius_m,truth_lat_deg,truth_lon_deg,truth_yaw_deg\n",
    );
    let mut truth = String::from("file,water_share,agl_m,gsd_m,yaw_deg,pitch_deg,roll_deg,h00,h01,h02,h10,h11,h12,h20,h21,h22\n");
    let mut mostly_water = 0;
    for (i, stop) in way.iter().enumerate() {
        let file = format!("frames/{i:05}.png");
        let Stop { waypoint, view } = stop;
        let at = ground.position(waypoint.x, waypoint.y);
        let to_field = ground.local_axes(at);
        let drift_m = 0.4 * exposure.normal();
        let (sin, cos) = waypoint.track_deg.to_radians().sin_cos();
        let counts = expose(&night, &options.sensor, view, to_field, [drift_m * sin, drift_m * cos], &mut faults, &mut exposure);
        write_png(&options.out.join(&file), &counts, &options.sensor)?;

        let stamp_ns = match options.trajectory {
            Trajectory::Random => FIRST_STAMP_NS + i as i64 * 10_000_000_000,
            _ => FIRST_STAMP_NS + (waypoint.along_m / options.speed_mps * 1e9).round() as i64,
        };
        let error = 1.0 + options.scale_noise * dice.range(-1.0, 1.0);
        let yaw_deg = (view.yaw_deg + options.yaw_noise_deg * dice.range(-1.0, 1.0)).rem_euclid(360.0);
        let gsd_m = options.sensor.gsd_m(view.agl_m);
        let (radius, angle) = (options.radius_m * dice.unit().sqrt(), dice.range(0.0, std::f64::consts::TAU));
        let prior = at.offset(Enu { east_m: radius * angle.sin(), north_m: radius * angle.cos() });
        let attitude = if options.report_attitude { format!("{:.4},{:.4}", view.pitch_deg, view.roll_deg) } else { ",".into() };
        let prior = if i % options.prior_every == 0 {
            format!("{:.9},{:.9},{}", prior.lat_deg, prior.lon_deg, options.radius_m)
        } else {
            ",,".into()
        };
        let _ = writeln!(
            poses,
            "{file},{stamp_ns},{:.3},{:.5},{yaw_deg:.4},{attitude},{prior},{:.9},{:.9},{:.4}",
            view.agl_m * error,
            gsd_m * error,
            at.lat_deg,
            at.lon_deg,
            view.yaw_deg
        );
        let water_share = ground.water_share(waypoint, view.yaw_deg);
        mostly_water += usize::from(water_share > 0.6);
        let h = options
            .sensor
            .ground_homography(view)
            .as_flattened()
            .iter()
            .map(|v| format!("{v:.9e}"))
            .collect::<Vec<_>>()
            .join(",");
        let _ = writeln!(
            truth,
            "{file},{water_share:.4},{:.3},{gsd_m:.6},{:.4},{:.4},{:.4},{h}",
            view.agl_m, view.yaw_deg, view.pitch_deg, view.roll_deg
        );
        progress(i + 1, way.len());
    }
    for (name, text) in [("poses.csv", poses), ("truth.csv", truth), ("flight.toml", header(options, &ground))] {
        let path = options.out.join(name);
        std::fs::write(&path, text).map_err(file_error(&path))?;
    }
    Ok(SimulateReport {
        frames: way.len(),
        mostly_water,
        map: ground.map_name,
        classes: ground.has_classes,
        gsd_m: options.sensor.gsd_m(options.agl_m),
    })
}

/// Refuses options that cannot be meant.
fn check(o: &SimulateOptions) -> Result<(), SimulateError> {
    let refuse = |option, expected: &str, found: String| Err(SimulateError::Option { option, expected: expected.into(), found });
    let positive =
        [("agl-m", o.agl_m), ("speed-mps", o.speed_mps), ("lane-m", o.lane_m), ("area-m", o.area_m), ("radius-m", o.radius_m)];
    for (option, value) in positive {
        if !(value.is_finite() && value > 0.0) {
            return refuse(option, "a positive number", value.to_string());
        }
    }
    let shares = [
        ("yaw-noise-deg", o.yaw_noise_deg, 180.0),
        ("scale-noise", o.scale_noise, 0.5),
        ("attitude-noise-deg", o.attitude_noise_deg, 20.0),
        ("noise", o.sensor.noise, 100.0),
    ];
    for (option, value, most) in shares {
        if !(0.0..=most).contains(&value) {
            return refuse(option, &format!("0 to {most}"), value.to_string());
        }
    }
    if o.frames == 0 || o.frames > 100_000 {
        return refuse("frames", "1 to 100000", o.frames.to_string());
    }
    if o.prior_every == 0 {
        return refuse("prior-every", "at least 1", "0".into());
    }
    if !(1.0..=150.0).contains(&o.sensor.hfov_deg) {
        return refuse("hfov-deg", "1 to 150", o.sensor.hfov_deg.to_string());
    }
    if o.sensor.width.min(o.sensor.height) < 16 || o.sensor.width.max(o.sensor.height) > 4096 {
        return refuse("sensor", "16 to 4096 px a side", format!("{} x {}", o.sensor.width, o.sensor.height));
    }
    if o.area_m > 6000.0 {
        return refuse("area-m", "at most 6000", o.area_m.to_string());
    }
    if let MapSource::World(w) = &o.source {
        let side_px = w.size_m / w.m_per_px;
        if !(w.m_per_px > 0.0 && (64.0..=8000.0).contains(&side_px)) {
            return refuse("world-size-m / world-m-per-px", "64 to 8000 px", format!("{side_px}"));
        }
    }
    Ok(())
}

/// A frame to be: where, and how the camera looks.
struct Stop {
    waypoint: Waypoint,
    view: View,
}

/// The stops of the flight.
fn way(ground: &Ground, options: &SimulateOptions, dice: &mut Dice) -> Result<Vec<Stop>, SimulateError> {
    let gsd = options.sensor.gsd_m(options.agl_m);
    let (width_m, height_m) = (gsd * options.sensor.width as f64, gsd * options.sensor.height as f64);
    let n = ground.scene.size_px as f64;
    let (mut left, mut right, mut top, mut bottom) = (n, 0.0_f64, n, 0.0_f64);
    for (i, _) in ground.scene.valid.iter().enumerate().filter(|(_, v)| **v == 1) {
        let (x, y) = ((i % ground.scene.size_px) as f64, (i / ground.scene.size_px) as f64);
        (left, right, top, bottom) = (left.min(x), right.max(x), top.min(y), bottom.max(y));
    }
    let reach = width_m.hypot(height_m) / 2.0 / ground.window.m_per_px * 1.02;
    let rect = (left + reach, right - reach, top + reach, bottom - reach);
    let planned = match options.trajectory {
        Trajectory::Random => None,
        _ if rect.0 >= rect.1 || rect.2 >= rect.3 => return Err(SimulateError::NoPlace { frame: 0, width_m, height_m }),
        Trajectory::Lawnmower => Some(lawnmower(rect, ground.window.m_per_px, options.lane_m, options.frames)),
        Trajectory::Line => Some(line(rect, ground.window.m_per_px, options.frames, dice)),
    };
    let mut stops = Vec::with_capacity(options.frames);
    for frame in 0..options.frames {
        let fixed = planned.as_ref().and_then(|p| p.get(frame)).copied();
        let stop = (0..ATTEMPTS).find_map(|_| {
            let waypoint = fixed.unwrap_or_else(|| Waypoint {
                x: dice.range(left, right),
                y: dice.range(top, bottom),
                track_deg: dice.range(0.0, 360.0),
                along_m: 0.0,
            });
            let yaw_deg = match options.heading {
                Heading::Random => dice.range(0.0, 360.0),
                Heading::Track => waypoint.track_deg,
                Heading::North => 0.0,
            };
            let sigma = options.attitude_noise_deg;
            let view = View { agl_m: options.agl_m, yaw_deg, pitch_deg: sigma * dice.normal(), roll_deg: sigma * dice.normal() };
            ground.holds(&waypoint, &view, &options.sensor).then_some(Stop { waypoint, view })
        });
        stops.push(stop.ok_or(SimulateError::NoPlace { frame, width_m, height_m })?);
    }
    Ok(stops)
}

/// Opens or makes the map and reads the area of the flight.
fn open(options: &SimulateOptions) -> Result<Ground, SimulateError> {
    let (path, classes) = match &options.source {
        MapSource::World(world) => {
            let paths = (options.out.join("world.tif"), options.out.join("world_classes.tif"));
            write_world(world, &paths.0, &paths.1)?;
            (paths.0, Some(paths.1))
        }
        MapSource::File { map, classes } => (map.clone(), classes.clone()),
    };
    let map = GeoTiff::open(&path)?;
    let window = area(&map, options)?;
    Ground::read(map, &path, classes.as_deref(), &window)
}

/// The square to render: the whole map, or of a larger one a part drawn from the seed.
fn area(map: &GeoTiff, options: &SimulateOptions) -> Result<WindowSpec, SimulateError> {
    let (w, h) = (f64::from(map.size_px().0), f64::from(map.size_px().1));
    let middle = map.centre()?;
    let (mut lo, mut hi) = (Enu { east_m: f64::MAX, north_m: f64::MAX }, Enu { east_m: f64::MIN, north_m: f64::MIN });
    for i in 0..=4 {
        for j in 0..=4 {
            let (x, y) = map.affine().apply(w * f64::from(i) / 4.0 - 0.5, h * f64::from(j) / 4.0 - 0.5);
            let at = middle.enu_to(map.crs().inverse(x, y)?);
            lo = Enu { east_m: lo.east_m.min(at.east_m), north_m: lo.north_m.min(at.north_m) };
            hi = Enu { east_m: hi.east_m.max(at.east_m), north_m: hi.north_m.max(at.north_m) };
        }
    }
    let mut dice = Dice::new(options.seed, 202);
    let mut place = |lo: f64, hi: f64| {
        let spare = ((hi - lo) - options.area_m).max(0.0);
        (lo + hi) / 2.0 + spare * (dice.unit() - 0.5)
    };
    let centre = middle.offset(Enu { east_m: place(lo.east_m, hi.east_m), north_m: place(lo.north_m, hi.north_m) });
    let width_m = (hi.east_m - lo.east_m).max(hi.north_m - lo.north_m).min(options.area_m);
    Ok(WindowSpec { centre, width_m, m_per_px: map.m_per_px().clamp(1.0, 10.0) })
}

/// Makes a world and writes it with its land cover.
fn write_world(options: &WorldOptions, map: &Path, classes_map: &Path) -> Result<(), SimulateError> {
    let world = make_world(options);
    let (code, left, top) = WORLD_PLACE;
    let crs = Crs::from_epsg(code)?;
    let m = options.m_per_px;
    let affine = Affine([m, 0.0, left + m / 2.0, 0.0, -m, top - m / 2.0]);
    write_rgb(map, &world.rgb, world.size_px, world.size_px, &affine, &crs)?;
    let side = world.size_px as u32;
    classes::write(classes_map, &world.classes, side, side, &affine, &crs)
        .map_err(|why| SimulateError::File { path: classes_map.to_owned(), why })
}

/// `flight.toml`. A map outside the folder is not named: replay is then told by `--map`.
fn header(options: &SimulateOptions, ground: &Ground) -> String {
    let (map, over) = match &options.source {
        MapSource::World(w) => ("map = \"world.tif\"\n", format!("procedural world {}", w.seed)),
        MapSource::File { .. } => ("", format!("map {}", ground.map_name)),
    };
    let name = format!("simulated over {over}, seed {}", options.seed);
    let notes = "Rendered by nightfix simulate; see truth.csv for the true poses.";
    format!("schema = 1\nname = {name:?}\n{map}notes = {notes:?}\n\n[camera]\nhfov_deg = {}\n", options.sensor.hfov_deg)
}

/// 14-bit counts as a 16-bit PNG.
fn write_png(path: &Path, counts: &[u16], sensor: &Sensor) -> Result<(), SimulateError> {
    use image::codecs::png::{CompressionType, FilterType, PngEncoder};
    use image::{ExtendedColorType, ImageEncoder};
    let error = |why: String| SimulateError::File { path: path.to_owned(), why };
    let bytes: Vec<u8> = counts.iter().flat_map(|c| c.to_ne_bytes()).collect();
    let file = std::fs::File::create(path).map_err(|e| error(e.to_string()))?;
    let encoder = PngEncoder::new_with_quality(std::io::BufWriter::new(file), CompressionType::Default, FilterType::Up);
    encoder
        .write_image(&bytes, sensor.width as u32, sensor.height as u32, ExtendedColorType::L16)
        .map_err(|e| error(e.to_string()))
}
