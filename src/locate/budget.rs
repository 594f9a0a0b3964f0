//! The error budget: what a fix may be off by, term by term. Uncalibrated, and saying so.

use super::{Answer, Evidence};
use crate::config::BudgetSettings;
use crate::thermal::Pose;

/// Quantiles of the squared radius of a two-dimensional standard normal: `-2 ln(1 - p)`.
const CHI2_095: f64 = 5.991_464_547_107_98;
const CHI2_0999: f64 = 13.815_510_557_964_27;

/// Evidence: metres on the ground per radian of tilt.
const TILT_LEVER: &str = "tilt_lever_m";

/// A fix's stated error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StatedError {
    /// East-north, square metres.
    pub covariance_enu_m2: [[f64; 2]; 2],
    /// Radius that holds the truth with probability 0.95, metres.
    pub radius95_m: f64,
    /// With 0.999.
    pub radius999_m: f64,
}

/// covariance = match^2 + (agl x sec^2(t) x tilt)^2 + map^2 + (stamp x speed)^2 + floor^2 per axis. `match_sigma_m` is the calibration's
/// for this match, else the last stage's, from the bundle; `tail999` is the radius of 0.999 in sigmas where the calibration
/// found a wider one than a Gaussian's. t is the angle between the optical axis and the vertical: where the axis meets the
/// ground, at agl x tan(t), moves by agl x sec^2(t) per radian.
/// Where pitch or roll are unknown, nadir was assumed and the tilt is `sigma_tilt_unknown_deg`; where the height is
/// unknown, `assumed_agl_m` stands in. Each term goes into the evidence.
pub fn stated_error(
    settings: &BudgetSettings,
    match_sigma_m: f64,
    tail999: f64,
    pose: &Pose,
    agl_m: Option<f64>,
    evidence: &mut Evidence,
) -> StatedError {
    let tilt_deg = if pose.tilt_known() { settings.sigma_tilt_deg } else { settings.sigma_tilt_unknown_deg };
    let lever_m = agl_m.unwrap_or(settings.assumed_agl_m) / cos_tilt(pose).powi(2);
    let tilt_m = lever_m * tilt_deg.to_radians();
    evidence.insert(TILT_LEVER.into(), lever_m);
    let mut variance_m2 = 0.0;
    for (name, sigma_m) in [
        ("sigma_match_m", match_sigma_m),
        ("sigma_tilt_m", tilt_m),
        ("sigma_map_m", settings.map_sigma_m),
        ("sigma_stamp_m", settings.sigma_stamp_s * settings.speed_mps),
        ("sigma_floor_m", settings.floor_m),
    ] {
        evidence.insert(name.into(), sigma_m);
        variance_m2 += sigma_m * sigma_m;
    }
    let covariance_enu_m2 = [[variance_m2, 0.0], [0.0, variance_m2]];
    let sigma_m = largest_sigma_m(&covariance_enu_m2);
    let radius999_m = CHI2_0999.sqrt().max(tail999) * sigma_m;
    StatedError { covariance_enu_m2, radius95_m: CHI2_095.sqrt() * sigma_m, radius999_m }
}

/// Of the angle between the optical axis and the vertical; beyond 60 degrees, where no frame is rectified, as there.
pub(super) fn cos_tilt(pose: &Pose) -> f64 {
    let cos = |deg: Option<f64>| deg.unwrap_or(0.0).to_radians().cos();
    (cos(pose.pitch_deg) * cos(pose.roll_deg)).max(0.5)
}

/// For a fix whose camera's pitch and roll were not measured but taken from its mount on a level vehicle: the tilt's term
/// becomes that of an unknown tilt.
pub fn tilt_was_assumed(settings: &BudgetSettings, answer: &mut Answer) {
    let Answer { outcome: Ok(fix), evidence, .. } = answer else { return };
    let (Some(lever_m), Some(sigma_m)) = (evidence.get(TILT_LEVER).copied(), evidence.get_mut("sigma_tilt_m")) else { return };
    let unknown_m = lever_m * settings.sigma_tilt_unknown_deg.to_radians();
    let more_m2 = (unknown_m * unknown_m - *sigma_m * *sigma_m).max(0.0);
    *sigma_m = sigma_m.max(unknown_m);
    let before_m2 = largest_sigma_m(&fix.covariance_enu_m2).powi(2);
    let growth = (1.0 + more_m2 / before_m2).sqrt();
    let [[ee, _], [_, nn]] = &mut fix.covariance_enu_m2;
    *ee += more_m2;
    *nn += more_m2;
    fix.radius95_m *= growth;
    fix.radius999_m *= growth;
}

/// Square root of the larger eigenvalue of a covariance, metres: no axis is worse. With unequal axes the circle of this sigma
/// holds more than its probability, never less.
pub fn largest_sigma_m(covariance_m2: &[[f64; 2]; 2]) -> f64 {
    let [[ee, en], [_, nn]] = *covariance_m2;
    let mean = 0.5 * (ee + nn);
    (mean + (0.5 * (ee - nn)).hypot(en)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::locate::Fix;

    const SETTINGS: BudgetSettings = BudgetSettings {
        sigma_tilt_deg: 0.5,
        sigma_tilt_unknown_deg: 2.0,
        assumed_agl_m: 500.0,
        map_sigma_m: 1.0,
        sigma_stamp_s: 0.02,
        speed_mps: 20.0,
        floor_m: 0.5,
    };

    #[test]
    fn terms_add_in_squares_and_are_named() {
        let pose = Pose { pitch_deg: Some(1.0), roll_deg: Some(0.0), ..Pose::default() };
        let mut evidence = Evidence::new();
        let error = stated_error(&SETTINGS, 3.0, 0.0, &pose, Some(100.0), &mut evidence);
        let tilt = 100.0 / 1f64.to_radians().cos().powi(2) * 0.5f64.to_radians();
        let variance = 9.0 + tilt * tilt + 1.0 + 0.16 + 0.25;
        assert!((error.covariance_enu_m2[0][0] - variance).abs() < 1e-12 && error.covariance_enu_m2[0][1] == 0.0);
        assert!((error.radius95_m - (5.991f64 * variance).sqrt()).abs() < 1e-3);
        assert!((error.radius999_m - (13.816f64 * variance).sqrt()).abs() < 1e-3);
        assert_eq!(evidence["sigma_match_m"], 3.0);
        assert_eq!((evidence["sigma_stamp_m"], evidence.len()), (0.4, 6));
        // A calibration that found wider tails than a Gaussian's widens the far radius only.
        let wide = stated_error(&SETTINGS, 3.0, 5.0, &pose, Some(100.0), &mut evidence);
        assert_eq!(wide.radius95_m, error.radius95_m);
        assert!((wide.radius999_m - 5.0 * variance.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn the_lever_of_a_tilted_camera_is_longer() {
        let tilt_m = |pitch_deg: f64, roll_deg: f64| {
            let pose = Pose { pitch_deg: Some(pitch_deg), roll_deg: Some(roll_deg), ..Pose::default() };
            let mut evidence = Evidence::new();
            stated_error(&SETTINGS, 3.0, 0.0, &pose, Some(400.0), &mut evidence);
            evidence["sigma_tilt_m"]
        };
        let nadir_m = 400.0 * SETTINGS.sigma_tilt_deg.to_radians();
        assert!((tilt_m(0.0, 0.0) - nadir_m).abs() < 1e-12);
        assert!((tilt_m(45.0, 0.0) - 2.0 * nadir_m).abs() < 1e-9 && (tilt_m(0.0, -45.0) - 2.0 * nadir_m).abs() < 1e-9);
        // As the axis really moves on the ground.
        let ground_m = |deg: f64| 400.0 * deg.to_radians().tan();
        let moved_m = (ground_m(30.0 + 0.05) - ground_m(30.0 - 0.05)) * SETTINGS.sigma_tilt_deg / 0.1;
        assert!((tilt_m(30.0, 0.0) - moved_m).abs() < 1e-3, "{} {moved_m}", tilt_m(30.0, 0.0));
        assert!(tilt_m(90.0, 0.0).is_finite());
    }

    #[test]
    fn what_is_unknown_costs() {
        let mut evidence = Evidence::new();
        let half_known = Pose { pitch_deg: Some(0.0), ..Pose::default() };
        stated_error(&SETTINGS, 1.0, 0.0, &half_known, None, &mut evidence);
        assert!((evidence["sigma_tilt_m"] - 500.0 * 2.0f64.to_radians()).abs() < 1e-12);
    }

    #[test]
    fn a_tilt_that_was_assumed_costs_as_an_unknown_one() {
        let stated = |pose: &Pose| {
            let mut evidence = Evidence::new();
            let error = stated_error(&SETTINGS, 3.0, 5.0, pose, Some(400.0), &mut evidence);
            let home = crate::geo::LatLon { lat_deg: 25.2, lon_deg: 55.3 };
            let StatedError { covariance_enu_m2, radius95_m, radius999_m } = error;
            let fix = Fix { covariance_enu_m2, radius95_m, radius999_m, calibrated: true, ..Fix::plain(home, 1.0) };
            Answer { evidence, ..Answer::bare(Ok(fix), None) }
        };
        let level = Pose { pitch_deg: Some(0.0), roll_deg: Some(0.0), ..Pose::default() };
        let (mut assumed, unknown) = (stated(&level), stated(&Pose::default()));
        tilt_was_assumed(&SETTINGS, &mut assumed);
        let (a, b) = (assumed.outcome.clone().unwrap(), unknown.outcome.clone().unwrap());
        assert!((a.covariance_enu_m2[0][0] - b.covariance_enu_m2[0][0]).abs() < 1e-9);
        assert!((a.covariance_enu_m2[1][1] - b.covariance_enu_m2[1][1]).abs() < 1e-9);
        assert!((a.radius95_m - b.radius95_m).abs() < 1e-9 && (a.radius999_m - b.radius999_m).abs() < 1e-9);
        assert!((assumed.evidence["sigma_tilt_m"] - unknown.evidence["sigma_tilt_m"]).abs() < 1e-12);
        let mut again = unknown.clone();
        tilt_was_assumed(&SETTINGS, &mut again);
        assert_eq!(again, unknown, "not twice");
    }

    #[test]
    fn unequal_axes_are_bounded_by_the_longer() {
        assert!((largest_sigma_m(&[[5.0, 4.0], [4.0, 5.0]]) - 3.0).abs() < 1e-12);
    }
}
