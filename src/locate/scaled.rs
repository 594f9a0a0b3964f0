//! Low frames: frame, window and D_C of a bundle scaled down together, the pixels staying as many. The message stays between
//! pixels of 1 m.

use crate::homography::Homography;
use crate::map::Window;
use crate::model::Manifest;

/// Share of the bundle's frame width from which on a footprint counts as whole.
const FULL_FOOTPRINT: f64 = 0.8;

/// The scale at which a frame is matched: 1, but less where its footprint is smaller than the bundle's and the bundle
/// supports it (`scale_range`).
pub fn scale_for(manifest: &Manifest, footprint_m: Option<f64>) -> f64 {
    let (Some([least, _]), Some(footprint_m)) = (manifest.scale_range, footprint_m) else { return 1.0 };
    let share = footprint_m / manifest.frame_width_m;
    // In steps of 1/8 octave: a window is kept while the height varies a little.
    let stepped = 2f64.powf((share.log2() * 8.0).floor() / 8.0);
    if share >= FULL_FOOTPRINT || !stepped.is_finite() { 1.0 } else { stepped.clamp(least, 1.0) }
}

/// The affine of the window without its margin.
pub fn inner_affine(window: &Window, margin_px: usize) -> [f64; 6] {
    let [a, b, c, d, e, f] = window.map_affine;
    let m = margin_px as f64;
    [a, b, c + (a + b) * m, d, e, f + (d + e) * m]
}

/// An affine of window pixels at `scale` m/px as one of pixels at 1 m/px.
pub fn affine_at_metres(affine: &[f64; 6], scale: f64) -> [f64; 6] {
    let [a, b, c, d, e, f] = *affine;
    // Pixel x at 1 m/px is (x + 0.5) / scale - 0.5 of the finer ones.
    let shift = 0.5 / scale - 0.5;
    [a / scale, b / scale, c + (a + b) * shift, d / scale, e / scale, f + (d + e) * shift]
}

/// A homography between squares at `scale` m/px as one between squares at 1 m/px: the frame's about its middle, the
/// window's from its corner.
pub fn homography_at_metres(found: &Homography, scale: f64, frame_px: usize) -> Homography {
    if scale == 1.0 {
        return *found;
    }
    let middle = (frame_px as f64 - 1.0) / 2.0;
    let frame =
        Homography([[1.0 / scale, 0.0, middle - middle / scale], [0.0, 1.0 / scale, middle - middle / scale], [0.0, 0.0, 1.0]]);
    let shift = 0.5 * scale - 0.5;
    let window = Homography([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]]);
    window.after(&found.after(&frame))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_of_a_metre_and_finer_ones_name_the_same_places() {
        let (scale, frame_px) = (0.25, 512);
        let fine = [0.25, 0.0, 1000.0, 0.0, -0.25, 5000.0];
        let metres = affine_at_metres(&fine, scale);
        let at = |a: &[f64; 6], x: f64, y: f64| [a[0] * x + a[1] * y + a[2], a[3] * x + a[4] * y + a[5]];
        // The corner of the picture is the same place, and so is the middle of 400 fine pixels, or 100 of a metre.
        for (fine_px, metre_px) in [(-0.5, -0.5), (399.5, 99.5)] {
            let (a, b) = (at(&fine, fine_px, fine_px), at(&metres, metre_px, metre_px));
            assert!((a[0] - b[0]).abs() < 1e-9 && (a[1] - b[1]).abs() < 1e-9, "{a:?} {b:?}");
        }
        // A frame laid on the window 40 fine pixels to the right of its corner: its middle and a point 10 m east of it.
        let found = Homography([[1.0, 0.0, 40.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let stated = homography_at_metres(&found, scale, frame_px);
        let middle = (frame_px as f64 - 1.0) / 2.0;
        for east_m in [0.0, 10.0] {
            let [x, _] = stated.apply(middle + east_m, middle);
            let fine_x = middle + east_m / scale + 40.0;
            assert!((x - ((fine_x + 0.5) * scale - 0.5)).abs() < 1e-9, "{x}");
        }
        assert_eq!(homography_at_metres(&found, 1.0, frame_px), found);
    }
}
