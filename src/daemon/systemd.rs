//! Telling the service manager: `sd_notify(3)`. Without `NOTIFY_SOCKET` nothing happens.

use super::throttle::Throttle;
use sd_notify::NotifyState;
use std::time::Duration;

/// The service manager.
#[derive(Debug, Default)]
pub struct Manager {
    failed: Throttle,
    said: String,
}

impl Manager {
    /// Ready to take frames.
    pub fn ready(&mut self, status: &str) {
        self.said = status.to_owned();
        self.notify(&[NotifyState::Ready, NotifyState::Status(status)]);
    }

    /// A line for `systemctl status`, where it differs from the last.
    pub fn status(&mut self, status: &str) {
        if self.said != status {
            self.said = status.to_owned();
            self.notify(&[NotifyState::Status(status)]);
        }
    }

    /// All is well.
    pub fn watchdog(&self) {
        self.notify(&[NotifyState::Watchdog]);
    }

    /// Starting or stopping takes longer than the manager may allow for.
    pub fn extend(&self, by: Duration) {
        self.notify(&[NotifyState::ExtendTimeoutUsec(u32::try_from(by.as_micros()).unwrap_or(u32::MAX))]);
    }

    /// On the way out.
    pub fn stopping(&mut self, status: &str) {
        self.said = status.to_owned();
        self.notify(&[NotifyState::Stopping, NotifyState::Status(status)]);
    }

    fn notify(&self, states: &[NotifyState<'_>]) {
        if let Err(error) = sd_notify::notify(states)
            && let Some(silent) = self.failed.open()
        {
            tracing::warn!(silent, "the service manager could not be told: {error}");
        }
    }
}

/// How often the watchdog is to be pinged: four times in its period, so that one late turn is no reason to be killed.
pub fn watchdog_period() -> Option<Duration> {
    sd_notify::watchdog_enabled().filter(|period| !period.is_zero()).map(|period| period / 4)
}
