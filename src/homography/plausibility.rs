//! Is this quad what a downward camera at that height could see?

use super::Quad;

/// What is expected, and how far off is still believed. From configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expected {
    /// Side of the frame's square, window pixels (metres).
    pub side_m: f64,
    /// Largest relative deviation of the scale (sqrt of the area ratio), e.g. 0.25.
    pub max_scale_error: f64,
    /// Largest rotation of the quad, degrees.
    pub max_rotation_deg: f64,
    /// Smallest ratio of opposite sides' lengths and of the diagonals (perspective, shear).
    pub min_side_ratio: f64,
}

/// Why it is not (reason `implausible_quad`).
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("quad: {what}: expected {expected}, found {found}")]
pub struct Implausible {
    /// Which property.
    pub what: &'static str,
    /// The bound.
    pub expected: String,
    /// The value.
    pub found: String,
}

/// Finite, convex and not mirrored, then scale, rotation, opposite sides, neighbouring sides and diagonals: in that order,
/// the first that fails is named.
///
/// # Errors
/// [`Implausible`], with the bound and the value.
pub fn check(quad: &Quad, expected: &Expected) -> Result<(), Implausible> {
    let implausible = |what, expected: String, found: String| Err(Implausible { what, expected, found });
    if !quad.is_finite() {
        return implausible("corners", "finite numbers".into(), format!("{:?}", quad.0));
    }
    if !quad.is_convex() {
        return implausible("shape", "convex, TL TR BR BL clockwise".into(), format!("{:.1?}", quad.0));
    }
    // Each test is written so that a NaN among the limits closes the gate.
    let scale = quad.area_px2().sqrt() / expected.side_m;
    let scale_fits = (scale - 1.0).abs() <= expected.max_scale_error;
    if !scale_fits {
        return implausible("scale", format!("1 +- {}", expected.max_scale_error), format!("{scale:.4}"));
    }
    let rotation_deg = quad.rotation_deg();
    let rotation_fits = rotation_deg.abs() <= expected.max_rotation_deg;
    if !rotation_fits {
        return implausible("rotation", format!("within {} degrees", expected.max_rotation_deg), format!("{rotation_deg:.2}"));
    }
    for (what, ratio) in ratios(quad) {
        let ratio_fits = ratio >= expected.min_side_ratio;
        if !ratio_fits {
            return implausible(what, format!("a ratio of at least {}", expected.min_side_ratio), format!("{ratio:.4}"));
        }
    }
    Ok(())
}

/// Shorter by longer, 0..=1, of what a square has equal.
fn ratios(quad: &Quad) -> [(&'static str, f64); 4] {
    let [tl, tr, bl, br] = quad.0;
    let length = |a: [f64; 2], b: [f64; 2]| (b[0] - a[0]).hypot(b[1] - a[1]);
    let ratio = |a: f64, b: f64| a.min(b) / a.max(b);
    let (top, bottom, left, right) = (length(tl, tr), length(bl, br), length(tl, bl), length(tr, br));
    [
        ("top and bottom sides", ratio(top, bottom)),
        ("left and right sides", ratio(left, right)),
        ("width and height", ratio(top + bottom, left + right)),
        ("diagonals", ratio(length(tl, br), length(tr, bl))),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXPECTED: Expected = Expected { side_m: 512.0, max_scale_error: 0.2, max_rotation_deg: 20.0, min_side_ratio: 0.8 };

    fn similar(scale: f64, angle_deg: f64) -> Quad {
        let (sin, cos) = angle_deg.to_radians().sin_cos();
        Quad(Quad::edges(512).0.map(|[x, y]| {
            let (x, y) = (scale * (x - 255.5), scale * (y - 255.5));
            [700.0 + x * cos - y * sin, 900.0 + x * sin + y * cos]
        }))
    }

    fn fails_with(quad: &Quad) -> Option<&'static str> {
        check(quad, &EXPECTED).err().map(|e| e.what)
    }

    #[test]
    fn squares_within_the_bounds_pass_and_others_name_what_is_wrong() {
        for (scale, angle_deg, failure) in [
            (1.0, 0.0, None),
            (1.19, 19.0, None),
            (0.81, -19.0, None),
            (1.21, 0.0, Some("scale")),
            (0.79, 0.0, Some("scale")),
            (1.0, 21.0, Some("rotation")),
            (1.0, -21.0, Some("rotation")),
            (1.0, 180.0, Some("rotation")),
            (0.0, 0.0, Some("shape")),
        ] {
            assert_eq!(fails_with(&similar(scale, angle_deg)), failure, "scale {scale}, {angle_deg} degrees");
        }
    }

    #[test]
    fn shapes_that_no_downward_camera_sees_are_named() {
        let [tl, tr, bl, br] = similar(1.0, 0.0).0;
        assert_eq!(fails_with(&Quad([tr, tl, br, bl])), Some("shape"), "mirrored");
        assert_eq!(fails_with(&Quad([tl, tr, br, bl])), Some("shape"), "bow");
        assert_eq!(fails_with(&Quad([tl, [f64::NAN, 0.0], bl, br])), Some("corners"));
        assert_eq!(fails_with(&Quad([tl, [f64::INFINITY, 0.0], bl, br])), Some("corners"));
        // A trapezium: the top side 75 % of the bottom one.
        let trapezium = Quad([[tl[0] + 64.0, tl[1]], [tr[0] - 64.0, tr[1]], bl, br]);
        assert_eq!(fails_with(&trapezium), Some("top and bottom sides"));
        // A rhomboid: sheared by half.
        let sheared = Quad([[tl[0] + 128.0, tl[1]], [tr[0] + 128.0, tr[1]], [bl[0] - 128.0, bl[1]], [br[0] - 128.0, br[1]]]);
        assert!(matches!(fails_with(&sheared), Some("diagonals" | "rotation")), "{:?}", fails_with(&sheared));
        // A rectangle of the right area.
        let flat = Quad(similar(1.0, 0.0).0.map(|[x, y]| [700.0 + (x - 700.0) * 1.25, 900.0 + (y - 900.0) * 0.8]));
        assert_eq!(fails_with(&flat), Some("width and height"));
    }

    #[test]
    fn the_message_carries_both_numbers() {
        let text = check(&similar(1.5, 0.0), &EXPECTED).err().map(|e| e.to_string());
        assert_eq!(text.as_deref(), Some("quad: scale: expected 1 +- 0.2, found 1.5000"));
    }
}
