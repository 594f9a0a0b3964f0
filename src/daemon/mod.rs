//! The service: tokio tasks round one `Localizer`, systemd, health.
