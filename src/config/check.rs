//! Values that a type cannot rule out: ranges, names, endpoints. NaN is in no range.

use super::layers::Source;
use super::{ConfigError, Settings};
use crate::model::Provider;
use std::str::FromStr;

/// A contract, not a preference: an own fix as prior is never taken as better than this per axis, metres.
const MIN_OWN_FIX_SIGMA_M: f64 = 50.0;
/// Widest disc of a search, metres: beyond, the region's flat lattice no longer lies on the ellipsoid to a cell.
pub const MAX_SEARCH_RADIUS_M: f64 = 50_000.0;
/// Further bundles: each holds sessions and a cache of its own.
const MAX_LADDER: usize = 8;

impl Settings {
    /// Checks every value.
    pub(super) fn check(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        let at_most = |field: &str, value: f64, most: f64| {
            let fits = value >= 0.0 && value <= most;
            fits.then_some(()).ok_or_else(|| source.error(field, format!("0 to {most}"), value))
        };
        let positive = |field: &str, value: f64, most: f64| {
            let fits = value > 0.0 && value <= most;
            fits.then_some(()).ok_or_else(|| source.error(field, format!("more than 0 and at most {most}"), value))
        };
        let between = |field: &str, value: f64, least: f64, most: f64| {
            let fits = value >= least && value <= most;
            fits.then_some(()).ok_or_else(|| source.error(field, format!("{least} to {most}"), value))
        };
        let whole = |field: &str, value: u64, least: u64, most: u64| {
            let fits = (least..=most).contains(&value);
            fits.then_some(()).ok_or_else(|| source.error(field, format!("{least} to {most}"), value))
        };

        let name = &self.vehicle.name;
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if name.is_empty() || name.len() > 64 || !name.chars().all(plain) {
            return Err(source.error("vehicle.name", "1 to 64 of the characters A-Z a-z 0-9 - _", format!("`{name}`")));
        }
        whole("map.cache_mib", self.map.cache_mib as u64, 1, 65_536)?;
        let provider = &self.onnxruntime.provider;
        if Provider::from_str(provider).is_err() {
            return Err(source.error("onnxruntime.provider", Provider::NAMES, format!("`{provider}`")));
        }
        whole("onnxruntime.threads", self.onnxruntime.threads as u64, 1, 256)?;

        if let Some(hfov_deg) = self.camera.hfov_deg {
            let fits = hfov_deg > 0.0 && hfov_deg < 180.0;
            fits.then_some(()).ok_or_else(|| source.error("camera.hfov_deg", "more than 0 and less than 180", hfov_deg))?;
        }
        between("camera.mount_roll_deg", self.camera.mount_roll_deg, -180.0, 180.0)?;
        between("camera.mount_pitch_deg", self.camera.mount_pitch_deg, -180.0, 180.0)?;
        between("camera.mount_yaw_deg", self.camera.mount_yaw_deg, -360.0, 360.0)?;

        let track = &self.track;
        positive("track.max_speed_mps", track.max_speed_mps, 1000.0)?;
        between("track.own_fix_sigma_m", track.own_fix_sigma_m, MIN_OWN_FIX_SIGMA_M, 100_000.0)?;
        whole("track.fall_back_after_no_fix", track.fall_back_after_no_fix.into(), 1, 1_000_000)?;
        positive("track.fall_back_after_s", track.fall_back_after_s, 86_400.0)?;
        positive("track.max_prior_age_s", track.max_prior_age_s, 86_400.0)?;
        at_most("track.jump_slack_m", track.jump_slack_m, 100_000.0)?;
        whole("track.confirmations", track.confirmations.into(), 1, 8)?;
        positive("track.confirm_distance_m", track.confirm_distance_m, 100_000.0)?;
        positive("track.confirm_after_s", track.confirm_after_s, 3600.0)?;
        positive("track.confirm_within_s", track.confirm_within_s, 3600.0)?;
        between("track.max_agreement_share", track.max_agreement_share, 0.0, 1.0)?;
        whole("track.steady_reports", track.steady_reports.into(), 1, 100)?;
        whole("track.frozen_frames", track.frozen_frames.into(), 2, 1_000_000)?;
        at_most("track.frozen_after_s", track.frozen_after_s, 3600.0)?;
        whole("track.track_lag_fixes", track.track_lag_fixes.into(), 1, 1000)?;
        positive("track.track_accel_mps2", track.track_accel_mps2, 1000.0)?;
        positive("track.track_gate", track.track_gate, 1e6)?;
        whole("track.track_restart_after", track.track_restart_after.into(), 1, 1000)?;

        let search = &self.search;
        at_most("search.max_radius_m", search.max_radius_m, MAX_SEARCH_RADIUS_M)?;
        whole("search.budget_ms", search.budget_ms, 1, 600_000)?;
        whole("search.candidates", search.candidates.into(), 1, 32)?;
        between("search.max_second", search.max_second, 0.0, 1.0)?;
        whole("search.max_features_mib", search.max_features_mib as u64, 16, 65_536)?;
        if self.bundle.ladder.len() > MAX_LADDER {
            return Err(source.error("bundle.ladder", format!("at most {MAX_LADDER} bundles"), self.bundle.ladder.len()));
        }

        let gates = &self.gates;
        between("gates.min_map_valid", gates.min_map_valid, 0.0, 1.0)?;
        between("gates.min_frame_valid", gates.min_frame_valid, 0.0, 1.0)?;
        at_most("gates.min_frame_std", gates.min_frame_std, 255.0)?;
        at_most("gates.max_scale_error", gates.max_scale_error, 10.0)?;
        at_most("gates.max_rotation_deg", gates.max_rotation_deg, 180.0)?;
        between("gates.min_side_ratio", gates.min_side_ratio, 0.0, 1.0)?;
        between("gates.min_peak_mass", gates.min_peak_mass, 0.0, 1.0)?;
        between("gates.max_second_peak", gates.max_second_peak, 0.0, 1.0)?;
        at_most("gates.max_stage_shift_m", gates.max_stage_shift_m, 100_000.0)?;
        at_most("gates.max_refine_residual_m", gates.max_refine_residual_m, 100_000.0)?;
        between("gates.max_p_over_25m", gates.max_p_over_25m, 0.0, 1.0)?;

        let budget = &self.budget;
        at_most("budget.sigma_tilt_deg", budget.sigma_tilt_deg, 90.0)?;
        at_most("budget.sigma_tilt_unknown_deg", budget.sigma_tilt_unknown_deg, 90.0)?;
        positive("budget.assumed_agl_m", budget.assumed_agl_m, 100_000.0)?;
        at_most("budget.map_sigma_m", budget.map_sigma_m, 100_000.0)?;
        at_most("budget.sigma_stamp_s", budget.sigma_stamp_s, 60.0)?;
        at_most("budget.speed_mps", budget.speed_mps, 1000.0)?;
        positive("budget.floor_m", budget.floor_m, 100_000.0)?;

        self.check_zenoh(source)?;

        whole("daemon.deadline_ms", self.daemon.deadline_ms, 1, 600_000)?;
        positive("daemon.max_attitude_age_s", self.daemon.max_attitude_age_s, 60.0)?;
        whole("daemon.max_frame_bytes", self.daemon.max_frame_bytes as u64, 1, 1 << 30)
    }

    fn check_zenoh(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        let zenoh = &self.zenoh;
        if !matches!(zenoh.mode.as_str(), "peer" | "client") {
            return Err(source.error("zenoh.mode", "`peer` or `client`", format!("`{}`", zenoh.mode)));
        }
        let lists = [("zenoh.connect.endpoints", &zenoh.connect.endpoints), ("zenoh.listen.endpoints", &zenoh.listen.endpoints)];
        for (field, endpoints) in lists {
            for endpoint in endpoints {
                if zenoh::config::EndPoint::from_str(endpoint).is_err() {
                    let expected = "an endpoint such as `tcp/127.0.0.1:7447`";
                    return Err(source.error(field, expected, format!("`{endpoint}`")));
                }
            }
        }
        if zenoh.mode == "client" && zenoh.connect.endpoints.is_empty() && !zenoh.multicast {
            return Err(source.error("zenoh.connect.endpoints", "at least one endpoint in mode `client`", "none"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::Settings;
    use std::path::Path;

    fn refuses(section: &str, line: &str) {
        let (key, _) = line.split_once(" = ").unwrap();
        let error = Settings::from_toml(&format!("[{section}]\n{line}\n"), Path::new("a.toml")).unwrap_err().to_string();
        assert!(
            error.starts_with("configuration `a.toml`:2:") && error.contains(&format!("{section}.{key}: ")),
            "{line}: {error}"
        );
    }

    #[test]
    fn no_number_escapes_its_range() {
        let defaults: toml::Table = toml::from_str(super::super::DEFAULTS).unwrap();
        for (section, table) in &defaults {
            for (key, value) in table.as_table().unwrap() {
                if value.is_float() {
                    for bad in ["nan", "inf", "-inf", "-1e9", "1e9"] {
                        refuses(section, &format!("{key} = {bad}"));
                    }
                } else if value.is_integer() {
                    for bad in ["0", "9000000000000000"] {
                        // What does not fit the type is refused by the parser, which names the place only.
                        let text = format!("[{section}]\n{key} = {bad}\n");
                        let error = Settings::from_toml(&text, Path::new("a.toml")).unwrap_err().to_string();
                        assert!(error.starts_with("configuration `a.toml`:2:"), "{text}: {error}");
                    }
                }
            }
        }
        for bad in ["0", "180", "nan", "-3.0"] {
            refuses("camera", &format!("hfov_deg = {bad}"));
        }
    }

    #[test]
    fn names_modes_and_endpoints_are_checked() {
        for bad in ["", "a/b", "a b", "*", "$*", "@v", "ü", &"x".repeat(65)] {
            refuses("vehicle", &format!("name = \"{bad}\""));
        }
        refuses("onnxruntime", "provider = \"CPU\"");
        refuses("track", "own_fix_sigma_m = 10.0");
        // 0 would be any answer, the same one among them.
        refuses("track", "confirm_distance_m = 0.0");
        refuses("track", "confirm_after_s = 0.0");
        refuses("zenoh", "mode = \"router\"");
        refuses("zenoh", "connect.endpoints = [\"127.0.0.1:7447\"]");
        refuses("zenoh", "listen.endpoints = [\"tcp/127.0.0.1:7447\", \"\"]");
        let error = Settings::from_toml("[zenoh]\nmode = \"client\"\n", Path::new("a.toml")).unwrap_err().to_string();
        assert!(error.contains("zenoh.connect.endpoints: expected at least one"), "{error}");
    }
}
