//! The gates behind a match: each has a name that reaches the subscriber.

use super::{Evidence, FrameView, NoFix, Reason};
use crate::config::GateSettings;
use crate::homography::{Expected, Homography, Quad, check};
use crate::map::Window;
use crate::model::{Judgement, MissingCue};

/// Points along a side of the grid on which the map under a quad is probed.
const PROBES: usize = 96;

impl NoFix {
    /// With what was expected and what was found.
    pub fn new(reason: Reason, detail: impl Into<String>) -> Self {
        Self { reason, detail: detail.into() }
    }
}

/// Gates on the frame before anything is searched: `footprint_too_small`, `flat_frame`.
pub fn judge_frame(frame: &FrameView<'_>, settings: &GateSettings, evidence: &mut Evidence) -> Result<(), NoFix> {
    let seen = frame.seen.iter().filter(|seen| **seen != 0).count();
    let share = seen as f64 / frame.seen.len().max(1) as f64;
    evidence.insert("frame_valid".into(), share);
    if !(share >= settings.min_frame_valid) || seen == 0 {
        let detail = format!(
            "share of the {0} x {0} m square that was seen: expected at least {1}, found {share:.3}",
            frame.size_px, settings.min_frame_valid
        );
        return Err(NoFix::new(Reason::FootprintTooSmall, detail));
    }
    let values = || frame.gray.iter().zip(frame.seen).filter(|(_, seen)| **seen != 0).map(|(gray, _)| u64::from(*gray));
    let (sum, squares) = values().fold((0u64, 0u64), |(s, q), v| (s + v, q + v * v));
    let mean = sum as f64 / seen as f64;
    let std = (squares as f64 / seen as f64 - mean * mean).max(0.0).sqrt();
    evidence.insert("frame_std".into(), std);
    if !(std >= settings.min_frame_std) {
        let detail =
            format!("standard deviation of the 8-bit frame: expected at least {}, found {std:.2}", settings.min_frame_std);
        return Err(NoFix::new(Reason::FlatFrame, detail));
    }
    Ok(())
}

/// `implausible_quad`. With an unknown yaw any rotation is plausible.
pub fn judge_quad(quad: &Quad, side_m: f64, yaw_known: bool, settings: &GateSettings) -> Result<(), NoFix> {
    let expected = Expected {
        side_m,
        max_scale_error: settings.max_scale_error,
        max_rotation_deg: if yaw_known { settings.max_rotation_deg } else { 180.0 },
        min_side_ratio: settings.min_side_ratio,
    };
    check(quad, &expected).map_err(|e| NoFix::new(Reason::ImplausibleQuad, e.to_string()))
}

/// `outside_prior`.
pub fn judge_distance(distance_m: f64, radius_m: f64) -> Result<(), NoFix> {
    if distance_m <= radius_m * (1.0 + 1e-9) {
        return Ok(());
    }
    let detail = format!("distance from the prior: expected at most {radius_m:.1} m, found {distance_m:.1} m");
    Err(NoFix::new(Reason::OutsidePrior, detail))
}

/// Share of valid map under the frame's square as fitted, probed on a grid; what lies beyond the window is not valid.
pub fn map_valid_share(homography: &Homography, frame_px: usize, window: &Window, margin_px: usize) -> f64 {
    let mut valid = 0usize;
    let step = frame_px as f64 / PROBES as f64;
    for i in 0..PROBES * PROBES {
        let (u, v) = ((i % PROBES) as f64, (i / PROBES) as f64);
        let [x, y] = homography.apply((u + 0.5) * step - 0.5, (v + 0.5) * step - 0.5);
        let (x, y) = ((x + margin_px as f64).round(), (y + margin_px as f64).round());
        let side = window.size_px as f64;
        if x >= 0.0 && y >= 0.0 && x < side && y < side {
            let at = y as usize * window.size_px + x as usize;
            valid += usize::from(window.valid.get(at).is_some_and(|valid| *valid != 0));
        }
    }
    valid as f64 / (PROBES * PROBES) as f64
}

/// `nodata`.
pub fn judge_map(share: f64, settings: &GateSettings) -> Result<(), NoFix> {
    if share >= settings.min_map_valid {
        return Ok(());
    }
    let detail =
        format!("share of valid map inside the fitted quad: expected at least {}, found {share:.3}", settings.min_map_valid);
    Err(NoFix::new(Reason::Nodata, detail))
}

/// `low_evidence`, then `ambiguous`: each bound applies where its number exists. The mass is for bundles without a
/// calibration, which weighs it with everything else: where the refine stage is sure, a coarse posterior of a third is
/// enough. Two peaks of similar weight share the posterior: for them its mass is that of both, so that they are told apart
/// from a posterior without peaks.
pub fn judge_evidence(evidence: &Evidence, calibrated: bool, settings: &GateSettings) -> Result<(), NoFix> {
    let second = evidence.get("second_peak").copied().unwrap_or(0.0);
    let rivals = if second > settings.max_second_peak { second } else { 0.0 };
    let enough = |mass: f64| calibrated || mass * (1.0 + rivals) >= settings.min_peak_mass;
    if let Some(mass) = evidence.get("peak_mass").filter(|mass| !enough(**mass)) {
        let detail = format!("posterior mass round the peak: expected at least {}, found {mass:.3}", settings.min_peak_mass);
        return Err(NoFix::new(Reason::LowEvidence, detail));
    }
    for (name, what, most) in [
        ("stage_shift_m", "distance between both stages' centres, m", settings.max_stage_shift_m),
        ("refine_residual_m", "residual of the refine stage, m", settings.max_refine_residual_m),
    ] {
        if let Some(found) = evidence.get(name).filter(|found| !(**found <= most)) {
            return Err(NoFix::new(Reason::LowEvidence, format!("{what}: expected at most {most}, found {found:.2}")));
        }
    }
    for (name, what) in [("second_peak", "second peak"), ("near_peak", "second peak near the first")] {
        if let Some(ratio) = evidence.get(name).filter(|ratio| !(**ratio <= settings.max_second_peak)) {
            let detail = format!("{what}, over the first: expected at most {}, found {ratio:.3}", settings.max_second_peak);
            return Err(NoFix::new(Reason::Ambiguous, detail));
        }
    }
    Ok(())
}

/// `low_evidence` by the bundle's calibration: what it says, or the cue that is missing. Tested last, so that two peaks are
/// `ambiguous` and not merely improbable. Nothing to test where the bundle is not calibrated.
pub fn judge_probability(
    judgement: Option<&Result<Judgement, MissingCue>>,
    bound_m: f64,
    settings: &GateSettings,
) -> Result<(), NoFix> {
    let most = settings.max_p_over_25m;
    match judgement {
        None => Ok(()),
        Some(Err(missing)) => Err(NoFix::new(Reason::LowEvidence, missing.to_string())),
        Some(Ok(found)) if found.p_over_bound <= most => Ok(()),
        Some(Ok(Judgement { p_over_bound: p, .. })) => {
            let detail = format!("probability of an error above {bound_m} m: expected at most {most}, found {p:.4}");
            Err(NoFix::new(Reason::LowEvidence, detail))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> GateSettings {
        GateSettings {
            enabled: true,
            min_map_valid: 0.9,
            min_frame_valid: 0.6,
            min_frame_std: 3.0,
            max_scale_error: 0.25,
            max_rotation_deg: 25.0,
            min_side_ratio: 0.7,
            min_peak_mass: 0.5,
            max_second_peak: 0.5,
            max_stage_shift_m: 40.0,
            max_refine_residual_m: 8.0,
            max_p_over_25m: 0.1,
            crops: true,
        }
    }

    #[test]
    fn frames_that_show_too_little_are_named() {
        let (gray, mut seen): (Vec<u8>, Vec<u8>) = ((0..64u32 * 64).map(|i| (i % 251) as u8).collect(), vec![1; 64 * 64]);
        let mut evidence = Evidence::new();
        assert!(judge_frame(&FrameView { size_px: 64, gray: &gray, seen: &seen }, &settings(), &mut evidence).is_ok());
        let flat = vec![128u8; 64 * 64];
        let reason =
            judge_frame(&FrameView { size_px: 64, gray: &flat, seen: &seen }, &settings(), &mut evidence).unwrap_err().reason;
        assert_eq!(reason, Reason::FlatFrame);
        // Flat where it was seen; the black rest is no structure.
        seen[..64 * 20].fill(0);
        let black: Vec<u8> = flat.iter().zip(&seen).map(|(g, s)| g * s).collect();
        let reason =
            judge_frame(&FrameView { size_px: 64, gray: &black, seen: &seen }, &settings(), &mut evidence).unwrap_err().reason;
        assert_eq!(reason, Reason::FlatFrame);
        seen[..64 * 30].fill(0);
        let reason =
            judge_frame(&FrameView { size_px: 64, gray: &gray, seen: &seen }, &settings(), &mut evidence).unwrap_err().reason;
        assert_eq!(reason, Reason::FootprintTooSmall);
    }

    #[test]
    fn evidence_is_judged_where_it_exists_and_low_comes_before_ambiguous() {
        let judge = |pairs: &[(&str, f64)]| {
            let evidence: Evidence = pairs.iter().map(|(name, value)| ((*name).into(), *value)).collect();
            judge_evidence(&evidence, false, &settings()).map_err(|no_fix| no_fix.reason)
        };
        assert_eq!(judge(&[]), Ok(()));
        assert_eq!(
            judge(&[("peak_mass", 0.5), ("second_peak", 0.5), ("stage_shift_m", 40.0), ("refine_residual_m", 8.0)]),
            Ok(())
        );
        assert_eq!(judge(&[("peak_mass", 0.49), ("second_peak", 0.4)]), Err(Reason::LowEvidence));
        assert_eq!(judge(&[("peak_mass", 0.49), ("second_peak", 0.9)]), Err(Reason::Ambiguous));
        assert_eq!(judge(&[("peak_mass", 0.2), ("second_peak", 0.9)]), Err(Reason::LowEvidence));
        assert_eq!(judge(&[("stage_shift_m", 40.1)]), Err(Reason::LowEvidence));
        assert_eq!(judge(&[("refine_residual_m", 8.1)]), Err(Reason::LowEvidence));
        assert_eq!(judge(&[("second_peak", 0.51)]), Err(Reason::Ambiguous));
        assert_eq!(judge(&[("second_peak", f64::NAN)]), Err(Reason::Ambiguous));
        assert_eq!(judge(&[("second_peak", 0.0), ("near_peak", 0.51)]), Err(Reason::Ambiguous));
    }

    #[test]
    fn map_beyond_the_window_or_without_data_is_not_valid() {
        let spec =
            crate::map::WindowSpec { centre: crate::geo::LatLon { lat_deg: 0.0, lon_deg: 0.0 }, width_m: 100.0, m_per_px: 1.0 };
        let valid: Vec<u8> = (0..100 * 100).map(|i| u8::from(i % 100 < 50)).collect();
        let window = Window { spec, size_px: 100, rgb: Vec::new(), valid, map_affine: [0.0; 6] };
        let shifted = |x: f64| Homography([[1.0, 0.0, x], [0.0, 1.0, 10.0], [0.0, 0.0, 1.0]]);
        assert!((map_valid_share(&shifted(0.0), 40, &window, 10) - 1.0).abs() < 1e-9);
        assert!((map_valid_share(&shifted(20.0), 40, &window, 10) - 0.5).abs() < 0.02);
        assert!((map_valid_share(&shifted(-30.0), 40, &window, 10) - 0.5).abs() < 0.02);
        assert_eq!(map_valid_share(&shifted(f64::NAN), 40, &window, 10), 0.0);
    }
}
