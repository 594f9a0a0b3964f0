//! 16-bit maps to 8 bits, by one rule that is settled once per map.
//!
//! Sensors of 10 to 14 bits are stored in 16; a shift by 8 would leave them black. So: `white` is the 99.5th percentile of
//! the valid colour samples in up to 16 chunks, spread evenly over the coarsest resolution in the file. Where `white` reaches
//! the upper half of the range (>= 32768), the map uses all its bits and a sample is shifted (`v >> 8`); else it is scaled,
//! `round(255 v / white)`, saturating. The same file gives the same rule on every run.

use super::MapError;
use super::geotiff::GeoTiff;

const PROBED_CHUNKS: u32 = 16;
const WHITE_SHARE: f64 = 0.995;

/// A table from 16 to 8 bits.
pub(super) struct Depth(Vec<u8>);

impl Depth {
    /// Settles the rule. `samples` gives the interleaved samples of a chunk.
    pub fn observe(map: &GeoTiff, mut samples: impl FnMut(usize, u32) -> Result<Vec<u16>, MapError>) -> Result<Self, MapError> {
        let coarsest = map.levels().len().saturating_sub(1);
        let mut counts = vec![0_u64; 1 << 16];
        if let Some(level) = map.levels().get(coarsest) {
            let written: Vec<u32> = (0..level.chunks_per_plane()).filter(|&c| !level.is_sparse(c)).collect();
            let colours = level.alpha.unwrap_or(level.bands).min(3);
            for i in 0..PROBED_CHUNKS.min(written.len() as u32) {
                let pick = u64::from(i) * written.len() as u64 / u64::from(PROBED_CHUNKS.min(written.len() as u32));
                let Some(&chunk) = written.get(pick as usize) else { continue };
                let values = samples(coarsest, chunk)?;
                let valid = values.chunks_exact(level.bands).flat_map(|p| p.iter().take(colours));
                for &value in valid.filter(|&&v| map.nodata() != Some(u32::from(v))) {
                    if let Some(count) = counts.get_mut(usize::from(value)) {
                        *count += 1;
                    }
                }
            }
        }
        Ok(Self::from_white(white(&counts)))
    }

    fn from_white(white: u32) -> Self {
        let table =
            |v: u32| if white >= 1 << 15 { (v >> 8) as u8 } else { ((v * 255 + white / 2) / white.max(1)).min(255) as u8 };
        Self((0..1 << 16).map(table).collect())
    }

    /// One sample.
    pub fn to_8_bit(&self, sample: u16) -> u8 {
        self.0.get(usize::from(sample)).copied().unwrap_or(u8::MAX)
    }
}

/// The value below or at which `WHITE_SHARE` of the samples lie; full range where there are none.
fn white(counts: &[u64]) -> u32 {
    let total: u64 = counts.iter().sum();
    let wanted = (total as f64 * WHITE_SHARE).ceil() as u64;
    let mut seen = 0;
    for (value, count) in (0_u32..).zip(counts) {
        seen += count;
        if total > 0 && seen >= wanted {
            return value.max(1);
        }
    }
    u32::from(u16::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_range_is_shifted_and_a_12_bit_sensor_is_stretched() {
        let full = Depth::from_white(60_000);
        assert_eq!([full.to_8_bit(255), full.to_8_bit(256), full.to_8_bit(65_535)], [0, 1, 255]);
        let twelve = Depth::from_white(4095);
        assert_eq!([twelve.to_8_bit(0), twelve.to_8_bit(4095), twelve.to_8_bit(2048), twelve.to_8_bit(9000)], [0, 255, 128, 255]);
    }

    #[test]
    fn white_is_a_percentile_that_a_few_glints_do_not_move() {
        let mut counts = vec![0; 1 << 16];
        counts[1000] = 9_990;
        counts[65_535] = 10;
        assert_eq!(white(&counts), 1000);
        assert_eq!(white(&vec![0; 1 << 16]), 65_535);
    }
}
