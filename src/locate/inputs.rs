//! Network inputs made of window and frame: the bundle's [`InputSpec`]s, carried out.

use super::resample::{RgbSampler, resize_f32, resize_u8};
use crate::model::{Content, InputSpec, Resize, Tensor};

/// A window with its margin: a north-up square of map at 1 m/px, interleaved RGB, 0 where there is no map.
#[derive(Debug, Clone, Copy)]
pub struct WindowView<'a> {
    /// Side with margin, pixels.
    pub size_px: usize,
    /// `size_px * size_px * 3` bytes.
    pub rgb: &'a [u8],
}

/// A rectified frame at 1 m/px.
#[derive(Debug, Clone, Copy)]
pub struct FrameView<'a> {
    /// Side, pixels.
    pub size_px: usize,
    /// `size_px * size_px` gray values; 0 where unseen.
    pub gray: &'a [u8],
    /// 1 where the sensor saw the ground, else 0.
    pub seen: &'a [u8],
}

impl<'a> WindowView<'a> {
    /// For sampling at any place.
    pub fn sampler(&self) -> RgbSampler<'a> {
        RgbSampler::new(self.rgb, self.size_px)
    }

    /// The map input of a coarse stage: the square without `inset_px` on each side, resized.
    pub fn input(&self, spec: &InputSpec, inset_px: usize) -> Tensor {
        let side = self.size_px.saturating_sub(2 * inset_px);
        let n = spec.size_px as usize;
        let planes = if inset_px == 0 {
            resize_u8(self.rgb, self.size_px, 3, n, spec.resize)
        } else {
            let lines = self.rgb.chunks_exact(self.size_px * 3).skip(inset_px).take(side);
            let inner: Vec<u8> = lines.flat_map(|line| line.iter().skip(inset_px * 3).take(side * 3)).copied().collect();
            resize_u8(&inner, side, 3, n, spec.resize)
        };
        Tensor { shape: vec![1, 3, n, n], data: planes }
    }
}

/// A resized frame: gray 0..1 (0 where unseen) and whether it was seen (0 or 1).
#[derive(Debug, Clone)]
pub struct SeenGray {
    /// Side, pixels.
    pub size_px: usize,
    /// Gray values.
    pub gray: Vec<f32>,
    /// 1 or 0.
    pub seen: Vec<f32>,
}

impl FrameView<'_> {
    /// Resizes gray and mask: gray is weighted by the mask, so that what was not seen does not darken its neighbours, and a
    /// pixel counts as seen where at least half of its weight was.
    ///
    /// `seen = [R(mask) >= 0.5]`, `gray = R(gray mask) / R(mask)` there and 0 elsewhere, R = half-pixel antialias.
    pub fn resized(&self, size_px: usize) -> SeenGray {
        let rule = Resize::HalfPixelAntialias;
        if self.seen.iter().all(|&seen| seen != 0) {
            let gray = resize_u8(self.gray, self.size_px, 1, size_px, rule);
            return SeenGray { size_px, gray, seen: vec![1.0; size_px * size_px] };
        }
        let mask: Vec<f32> = self.seen.iter().map(|&seen| if seen == 0 { 0.0 } else { 1.0 }).collect();
        let weighted: Vec<f32> = self.gray.iter().zip(&mask).map(|(&gray, mask)| f32::from(gray) / 255.0 * mask).collect();
        let share = resize_f32(&mask, self.size_px, size_px, rule);
        let gray = resize_f32(&weighted, self.size_px, size_px, rule);
        let gray = gray.iter().zip(&share).map(|(g, s)| if *s >= 0.5 { g / s } else { 0.0 }).collect();
        SeenGray { size_px, gray, seen: share.iter().map(|&s| if s >= 0.5 { 1.0 } else { 0.0 }).collect() }
    }

    /// The frame input of a matcher.
    pub fn input(&self, spec: &InputSpec) -> Tensor {
        let n = spec.size_px as usize;
        let shape = vec![1, spec.content.channels(), n, n];
        let data = match spec.content {
            Content::GrayMask => self.resized(n).channels(Content::GrayMask),
            content => {
                let gray = resize_u8(self.gray, self.size_px, 1, n, spec.resize);
                gray.repeat(content.channels())
            }
        };
        Tensor { shape, data }
    }
}

impl SeenGray {
    /// The channels of this content, planar.
    pub fn channels(&self, content: Content) -> Vec<f32> {
        match content {
            Content::GrayMask => [&self.gray[..], &self.seen[..]].concat(),
            content => self.gray.repeat(content.channels()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unseen_pixels_do_not_darken_seen_ones() {
        let (gray, seen): (Vec<u8>, Vec<u8>) = (0..64 * 64).map(|i| if i % 64 < 31 { (200, 1) } else { (0, 0) }).unzip();
        let small = FrameView { size_px: 64, gray: &gray, seen: &seen }.resized(32);
        for (gray, seen) in small.gray.iter().zip(&small.seen) {
            let expected = if *seen == 1.0 { 200.0 / 255.0 } else { 0.0 };
            assert!((gray - expected).abs() < 1e-5, "{gray} {seen}");
        }
        assert_eq!(small.seen[..32].iter().sum::<f32>(), 15.0 + 1.0);
    }

    #[test]
    fn a_margin_is_cut_off_where_a_stage_sees_the_window_only() {
        let rgb: Vec<u8> = (0..12 * 12 * 3).map(|i| if (i / 3 % 12) < 2 { 255 } else { 10 }).collect();
        let spec = InputSpec { size_px: 8, width_m: 8.0, content: Content::Rgb, resize: Resize::HalfPixelAntialias };
        let input = WindowView { size_px: 12, rgb: &rgb }.input(&spec, 2);
        assert!(input.data.iter().all(|v| (v - 10.0 / 255.0).abs() < 1e-6));
    }
}
