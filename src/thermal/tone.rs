//! The 16-to-8-bit tone mapping, versioned; the same in Python (`sthn.tone`), to the bit.
//!
//! Version 1, in integers only. With the `n` samples in ascending order, `x[0] ..= x[n - 1]`:
//! 1. `k = n / 200` (rounded down), `lo = x[k]`, `hi = x[n - 1 - k]`: 0.5 % at either end, so that a few hot or dead pixels
//!    or a flame do not set the scale;
//! 2. where `hi - lo < 64` the range is widened to 64 counts about its middle: `lo = floor((lo + hi - 64) / 2)`,
//!    `hi = lo + 64`. A frame without structure stays grey instead of becoming amplified noise, and nothing divides by 0;
//! 3. `v -> floor((510 (v - lo) + (hi - lo)) / (2 (hi - lo)))`, held within 0..=255: linear, rounded half up.
//!
//! Counts of 14 bit in a 16-bit word, or with any offset, come out the same; 8-bit frames pass unchanged.

use super::{RawFrame, Samples};

/// The version implemented here; a bundle states the one it was trained with.
pub const TONE_MAPPING: u32 = 1;

/// One sample in so many is cut off at either end.
const CUT_ONE_IN: usize = 200;
/// Least range, counts.
const MIN_RANGE: i64 = 64;
/// Number of values of a 16-bit sample.
const LEVELS: usize = 1 << 16;

/// An 8-bit frame, row-major.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrayFrame {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `width * height` values.
    pub pixels: Vec<u8>,
}

/// Maps a frame to 8 bits by version 1 of the rule; 8-bit frames pass unchanged.
pub fn tone_map(frame: &RawFrame) -> GrayFrame {
    let pixels = match &frame.samples {
        Samples::U8(pixels) => pixels.clone(),
        Samples::U16(samples) => stretch(samples),
    };
    GrayFrame { width: frame.width, height: frame.height, pixels }
}

fn stretch(samples: &[u16]) -> Vec<u8> {
    let Some(last) = samples.len().checked_sub(1) else { return Vec::new() };
    let histogram = histogram(samples);
    let cut = samples.len() / CUT_ONE_IN;
    let (mut lo, mut hi) = (order_statistic(&histogram, cut), order_statistic(&histogram, last - cut));
    if hi - lo < MIN_RANGE {
        lo = (lo + hi - MIN_RANGE).div_euclid(2);
        hi = lo + MIN_RANGE;
    }
    let range = hi - lo;
    // Divisions only where the value is neither 0 nor 255 already.
    let mut table = vec![0_u8; LEVELS];
    for (v, entry) in (0_i64..).zip(&mut table) {
        *entry = if v <= lo {
            0
        } else if v >= hi {
            255
        } else {
            ((510 * (v - lo) + range) / (2 * range)) as u8
        };
    }
    // An array, so that the compiler sees that no u16 is out of bounds.
    match <&[u8; LEVELS]>::try_from(table.as_slice()) {
        Ok(table) => samples.iter().map(|&v| table[usize::from(v)]).collect(),
        Err(_) => vec![0; samples.len()],
    }
}

fn histogram(samples: &[u16]) -> Vec<u32> {
    let mut counts = vec![0_u32; LEVELS];
    if let Ok(counts) = <&mut [u32; LEVELS]>::try_from(counts.as_mut_slice()) {
        for &v in samples {
            counts[usize::from(v)] += 1;
        }
    }
    counts
}

/// The value at `rank` (from 0) of the samples in ascending order.
fn order_statistic(histogram: &[u32], rank: usize) -> i64 {
    let mut up_to = 0_usize;
    for (value, &count) in histogram.iter().enumerate() {
        up_to += count as usize;
        if up_to > rank {
            return value as i64;
        }
    }
    histogram.len() as i64 - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(samples: Vec<u16>) -> RawFrame {
        RawFrame { width: samples.len() as u32, height: 1, samples: Samples::U16(samples) }
    }

    /// The rule as the module's page states it, by sorting.
    fn as_stated(samples: &[u16]) -> Vec<u8> {
        let mut sorted: Vec<i64> = samples.iter().map(|&v| i64::from(v)).collect();
        sorted.sort_unstable();
        let k = samples.len() / 200;
        let (mut lo, mut hi) = (sorted[k], sorted[samples.len() - 1 - k]);
        if hi - lo < 64 {
            lo = ((lo + hi - 64) as f64 / 2.0).floor() as i64;
            hi = lo + 64;
        }
        samples
            .iter()
            .map(|&v| (((510 * (i64::from(v) - lo) + hi - lo) as f64) / ((2 * (hi - lo)) as f64)).floor().clamp(0.0, 255.0) as u8)
            .collect()
    }

    proptest! {
        #[test]
        fn equals_the_rule_as_stated(base in 0_u16..60_000, span in 0_u16..5_000, values in prop::collection::vec(any::<u16>(), 1..2_000)) {
            let samples: Vec<u16> = values.iter().map(|v| base + v % (span + 1)).collect();
            prop_assert_eq!(tone_map(&frame(samples.clone())).pixels, as_stated(&samples));
        }

        #[test]
        fn an_offset_or_two_bits_more_make_no_difference(values in prop::collection::vec(0_u16..16_384, 200..1_000), offset in 0_u16..40_000) {
            let plain = tone_map(&frame(values.clone())).pixels;
            prop_assert_eq!(&tone_map(&frame(values.iter().map(|v| v + offset).collect())).pixels, &plain);
            prop_assert_eq!(&tone_map(&frame(values.iter().map(|v| v << 2).collect())).pixels, &plain);
        }
    }

    #[test]
    fn a_few_hot_and_dead_pixels_do_not_set_the_scale() {
        let mut samples: Vec<u16> = (0..10_000).map(|i| 20_000 + (i % 1_000)).collect();
        let clean = tone_map(&frame(samples.clone())).pixels;
        for i in 0..30 {
            samples[i * 300] = if i % 2 == 0 { 65_535 } else { 0 };
        }
        let disturbed = tone_map(&frame(samples)).pixels;
        let worst =
            clean.iter().zip(&disturbed).enumerate().filter(|(i, _)| i % 300 != 0).map(|(_, (a, b))| a.abs_diff(*b)).max();
        assert!(worst <= Some(2), "{worst:?}");
    }

    #[test]
    fn a_frame_without_structure_is_mid_grey() {
        for value in [0, 20_000, 65_535] {
            assert_eq!(tone_map(&frame(vec![value; 500])).pixels, vec![128; 500], "{value}");
        }
        assert!(tone_map(&frame(Vec::new())).pixels.is_empty());
    }

    #[test]
    fn eight_bits_pass_unchanged() {
        let raw = RawFrame { width: 3, height: 1, samples: Samples::U8(vec![7, 0, 255]) };
        assert_eq!(tone_map(&raw).pixels, vec![7, 0, 255]);
    }
}
