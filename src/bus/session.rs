//! Opening a session from the configuration.

use crate::config::ZenohSettings;
use std::io::Read;
use std::path::Path;
use zenoh::Config;

/// Largest Zenoh configuration file that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// How long Zenoh waits for a peer whose queue is full before it closes that link, microseconds. Its default of five
/// seconds would hold up the answers to everyone else for as long.
const WAIT_BEFORE_CLOSE_US: u64 = 1_000_000;

/// What can go wrong with the bus.
#[derive(Debug, thiserror::Error)]
#[error("zenoh: {action}: {why}")]
pub struct BusError {
    /// What was being done.
    pub action: String,
    /// Zenoh's words.
    pub why: String,
}

impl BusError {
    /// From Zenoh's error, which is any error.
    pub(crate) fn new(action: impl Into<String>, why: impl ToString) -> Self {
        Self { action: action.into(), why: why.to_string() }
    }
}

/// Zenoh's configuration from ours: the file, where one is named, with our settings on top. No environment variable
/// is read.
///
/// `max_message_bytes` bounds what Zenoh puts together from fragments before anyone looks at it.
pub fn zenoh_config(settings: &ZenohSettings, max_message_bytes: usize) -> Result<Config, BusError> {
    let mut config = match &settings.config_file {
        Some(file) => read(file)?,
        None => Config::default(),
    };
    let mut set = |key: &str, value: serde_json::Value| {
        config.insert_json5(key, &value.to_string()).map_err(|e| BusError::new(format!("setting `{key}` to {value}"), e))
    };
    set("mode", settings.mode.as_str().into())?;
    // Stated even when empty: left out, a peer would listen on every interface.
    set("listen/endpoints", settings.listen.endpoints.clone().into())?;
    set("connect/endpoints", settings.connect.endpoints.clone().into())?;
    set("scouting/multicast/enabled", settings.multicast.into())?;
    // An absent peer is no reason to stop: go on, and try for ever.
    set("connect/exit_on_failure", false.into())?;
    set("connect/timeout_ms", (-1).into())?;
    set("transport/link/rx/max_message_size", max_message_bytes.into())?;
    if settings.config_file.is_none() {
        // Gossip would connect us to what our peers know; shared memory would let a peer change what we have checked,
        // and costs memory for nothing at a few frames a second.
        set("scouting/gossip/enabled", false.into())?;
        set("transport/shared_memory/enabled", false.into())?;
        set("transport/link/tx/queue/congestion_control/block/wait_before_close", WAIT_BEFORE_CLOSE_US.into())?;
    } else if config.scouting().gossip().enabled().is_none() {
        config
            .insert_json5("scouting/gossip/enabled", "false")
            .map_err(|e| BusError::new("setting `scouting/gossip/enabled` to false", e))?;
    }
    Ok(config)
}

/// Opens a session: explicit endpoints, no multicast scouting, no gossip unless configured. A peer opens at once, with
/// or without others; a client waits here until its router is there.
pub async fn open(settings: &ZenohSettings, max_message_bytes: usize) -> Result<zenoh::Session, BusError> {
    let config = zenoh_config(settings, max_message_bytes)?;
    zenoh::open(config).await.map_err(|e| BusError::new("opening a session", e))
}

/// Reads a JSON5 file. (`Config::from_file` decides by the file's extension and reads without a bound.)
fn read(file: &Path) -> Result<Config, BusError> {
    let failed = |why: String| BusError::new(format!("reading `{}`", file.display()), why);
    let handle = std::fs::File::open(file).map_err(|e| failed(e.to_string()))?;
    let mut text = String::new();
    handle.take(MAX_FILE_BYTES + 1).read_to_string(&mut text).map_err(|e| failed(e.to_string()))?;
    if text.len() as u64 > MAX_FILE_BYTES {
        return Err(failed(format!("expected at most {MAX_FILE_BYTES} bytes, found more")));
    }
    Config::from_json5(&text).map_err(|e| failed(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    const MIB: usize = 1 << 20;

    fn settings() -> ZenohSettings {
        Settings::defaults().unwrap().zenoh
    }

    fn get(config: &Config, key: &str) -> String {
        config.get_json(key).unwrap()
    }

    #[test]
    fn by_default_nothing_listens_and_nothing_is_sought() {
        let config = zenoh_config(&settings(), MIB).unwrap();
        assert_eq!(get(&config, "listen/endpoints"), "[]");
        assert_eq!(get(&config, "connect/endpoints"), "[]");
        assert_eq!(get(&config, "scouting/multicast/enabled"), "false");
        assert_eq!(get(&config, "scouting/gossip/enabled"), "false");
        assert_eq!(get(&config, "transport/shared_memory/enabled"), "false");
        assert_eq!(get(&config, "mode"), "\"peer\"");
    }

    #[test]
    fn a_file_lies_under_our_settings() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("z.json5");
        let text = "{ /* theirs */ listen: { endpoints: ['tcp/0.0.0.0:7447'] }, scouting: { multicast: { enabled: true }, \
                    gossip: { enabled: true } }, transport: { unicast: { max_sessions: 7 } } }";
        std::fs::write(&file, text).unwrap();
        let mut settings = settings();
        settings.config_file = Some(file.clone());
        settings.connect.endpoints = vec!["tcp/127.0.0.1:7447".to_owned()];
        let config = zenoh_config(&settings, MIB).unwrap();
        assert_eq!(get(&config, "listen/endpoints"), "[]", "nothing listens that nightfix's configuration does not name");
        assert_eq!(get(&config, "scouting/multicast/enabled"), "false");
        assert_eq!(get(&config, "scouting/gossip/enabled"), "true", "configured, so on");
        assert_eq!(get(&config, "transport/unicast/max_sessions"), "7");
        assert_eq!(get(&config, "connect/endpoints"), "[\"tcp/127.0.0.1:7447\"]");
        for bad in ["{ modee: 'peer' }", "{", "", "{ mode: 'king' }"] {
            std::fs::write(&file, bad).unwrap();
            let error = zenoh_config(&settings, MIB).unwrap_err().to_string();
            assert!(error.contains("z.json5"), "{bad}: {error}");
        }
        settings.config_file = Some(folder.path().join("absent.json5"));
        assert!(zenoh_config(&settings, MIB).unwrap_err().to_string().contains("absent.json5"));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_peer_opens_with_nobody_there_and_listens_on_nothing() {
        let mut settings = settings();
        // A port where nobody listens: bound once, then free again.
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        settings.connect.endpoints = vec![format!("tcp/127.0.0.1:{port}")];
        let session = tokio::time::timeout(std::time::Duration::from_secs(20), open(&settings, MIB)).await.unwrap().unwrap();
        assert!(session.info().locators().await.is_empty());
        session.close().await.unwrap();
    }
}
