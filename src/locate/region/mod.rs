//! Features of a region of the map, and the frame correlated with all of it.
//!
//! Where a bundle's map encoder has no statistics over its input, features belong to the map: a region is encoded once, in
//! tiles on a lattice in ENU about the map's middle. A tile keeps the spectra of a block of N x N feature cells; against
//! them one transform of the frame per hypothesis gives the logits of N - n + 1 shifts a side (overlap-save), of which the
//! tile owns those up to the next tile.

mod blocks;
mod layout;
mod peaks;

pub use layout::{Disc, Layout, turned};
pub use peaks::{Place, Plane, peaks};

use super::correlate::Work;
use super::hypotheses::{Hypothesis, Turner, batch};
use super::inputs::FrameView;
use super::resample::resize_u8;
use super::stages::MAX_BATCH;
use super::{NoFix, Reason};
use crate::geo::LatLon;
use crate::map::{MapCache, WindowSpec};
use crate::model::{Bundle, Dim, GraphError, StageManifest, Tensor};
use blocks::Transforms;
use layout::{ALIGN_PX, RIM_PX, inside, tiles_of};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex32;
use std::sync::Arc;

/// Feature cells along a block's side: its transforms stay in the second cache.
pub const BLOCK_CELLS: usize = 256;
/// Hypotheses whose spectra are held at once.
const AT_ONCE: usize = 8;

/// A tile of the region.
struct Tile {
    /// For every pair of channels N x N values; empty where no shift is allowed.
    spectra: Vec<Complex32>,
    allowed: Vec<bool>,
    spec: WindowSpec,
}

impl Tile {
    fn bytes(&self) -> usize {
        size_of_val(&*self.spectra) + self.allowed.len()
    }
}

/// What is looked for.
#[derive(Debug, Clone, Copy)]
pub struct Sight<'a> {
    /// The rectified frame.
    pub frame: &'a FrameView<'a>,
    /// Its scale against the bundle's own.
    pub scale: f64,
    /// Hypotheses of yaw and scale.
    pub hypotheses: &'a [Hypothesis],
}

/// The tiles that are kept, of one bundle over one map.
pub struct Region {
    block: usize,
    capacity_bytes: usize,
    min_map_valid: f64,
    planner: FftPlanner<f32>,
    /// Last used first; all of one layout.
    tiles: Vec<([i64; 2], Arc<Tile>)>,
    layout: Option<Layout>,
    encodes: u64,
}

impl Region {
    /// None encoded yet. Blocks of `block` cells, at most `capacity_bytes` of tiles kept.
    pub fn new(block: usize, capacity_bytes: usize, min_map_valid: f64) -> Self {
        let (planner, tiles) = (FftPlanner::new(), Vec::new());
        Self { block, capacity_bytes, min_map_valid, planner, tiles, layout: None, encodes: 0 }
    }

    /// Tiles encoded so far.
    pub fn encodes(&self) -> u64 {
        self.encodes
    }

    /// Correlates the frame under every hypothesis with all of the map in the disc: tile by tile, nearest first, the
    /// highest logit of every shift. `Ok(None)` where `go_on` said no.
    pub fn correlate(
        &mut self,
        bundle: &mut Bundle,
        map: &mut MapCache,
        sight: &Sight<'_>,
        disc: &Disc,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Option<(Layout, Vec<Plane>)>, NoFix> {
        let StageManifest::Correlation(stage) = &bundle.manifest.coarse else {
            return Err(NoFix::new(Reason::NonFinite, "search: expected a coarse stage of kind correlation, found another"));
        };
        let layout = Layout::new(stage, self.block, sight.scale);
        let layout = layout.ok_or_else(|| NoFix::new(Reason::NonFinite, "search: expected a stride that divides 16"))?;
        if self.layout.replace(layout) != Some(layout) {
            self.tiles.clear();
        }
        let map_centre = map.map().centre().map_err(|e| NoFix::new(Reason::OffMap, e.to_string()))?;
        let wanted = tiles_of(&layout, map_centre, disc)?;
        let features = frame_features(bundle, sight, &layout)?;
        let fft = Transforms {
            n: layout.block,
            forward: self.planner.plan_fft_forward(layout.block),
            inverse: self.planner.plan_fft_inverse(layout.block),
        };
        let mut work = fft.work();
        let mut planes: Vec<Plane> = Vec::with_capacity(wanted.len());
        for (group, frames) in features.chunks(AT_ONCE).enumerate() {
            let frames: Vec<_> = frames.iter().map(|f| fft.spectra(&mut work, &f.data, layout.cells)).collect();
            for (i, at) in wanted.iter().enumerate() {
                if !go_on() {
                    return Ok(None);
                }
                let tile = self.tile(bundle, map, map_centre, &layout, *at, &fft, &mut work)?;
                self.make_room(&wanted);
                if planes.len() <= i {
                    planes.push(Plane::new(*at, tile.spec, layout.shifts));
                }
                let Some(plane) = planes.get_mut(i).filter(|_| !tile.spectra.is_empty()) else { continue };
                for (j, frame) in frames.iter().enumerate() {
                    let logits = fft.correlate(&mut work, frame, &tile.spectra, layout.shifts);
                    let at = group * AT_ONCE + j;
                    let Some(hypothesis) = sight.hypotheses.get(at) else { continue };
                    let inside = inside(&layout, &tile.spec, disc, hypothesis);
                    plane.take(&logits, at as u16, |i| tile.allowed.get(i).copied().unwrap_or(false) && inside(i))?;
                }
            }
        }
        Ok(Some((layout, planes)))
    }

    /// Drops tiles until the rest fits: first what this disc does not want, the longest unused first; then what was used just
    /// before, for discs are gone through in one order, and the first tiles come first again.
    fn make_room(&mut self, wanted: &[[i64; 2]]) {
        while self.tiles.len() > 1 && self.tiles.iter().map(|(_, tile)| tile.bytes()).sum::<usize>() > self.capacity_bytes {
            let unwanted = self.tiles.iter().rposition(|(at, _)| !wanted.contains(at)).filter(|i| *i > 0);
            self.tiles.remove(unwanted.unwrap_or(1));
        }
    }

    /// A tile, made or kept.
    #[allow(clippy::too_many_arguments, reason = "parts of one localizer and of one pass")]
    fn tile(
        &mut self,
        bundle: &mut Bundle,
        map: &mut MapCache,
        map_centre: LatLon,
        layout: &Layout,
        at: [i64; 2],
        fft: &Transforms,
        work: &mut Work,
    ) -> Result<Arc<Tile>, NoFix> {
        if let Some(i) = self.tiles.iter().position(|(kept, _)| *kept == at) {
            if let Some(found) = self.tiles.get_mut(..=i) {
                found.rotate_right(1);
            }
        } else {
            let spec = layout.spec(map_centre, at);
            let window = map.window(&spec).map_err(|e| NoFix::new(Reason::OffMap, e.to_string()))?;
            let allowed = layout.allowed(&window, self.min_map_valid);
            let spectra = if allowed.contains(&true) {
                self.encodes += 1;
                let features = encode(bundle, &window.rgb, window.size_px).map_err(failed)?;
                fft.tile_spectra(work, &features, RIM_PX / layout.stride)
            } else {
                Vec::new()
            };
            self.tiles.insert(0, (at, Arc::new(Tile { spectra, allowed, spec })));
        }
        let first = self.tiles.first().map(|(_, tile)| Arc::clone(tile));
        first.ok_or_else(|| NoFix::new(Reason::NonFinite, "search: expected a tile, found none"))
    }
}

/// The frame's features under every hypothesis, one tensor each.
fn frame_features(bundle: &mut Bundle, sight: &Sight<'_>, layout: &Layout) -> Result<Vec<Tensor>, NoFix> {
    let StageManifest::Correlation(stage) = &bundle.manifest.coarse else { return Ok(Vec::new()) };
    let turner = Turner::new(sight.frame, layout.frame_px);
    let inputs: Vec<Tensor> = sight.hypotheses.chunks(MAX_BATCH).map(|chunk| batch(&turner, stage, chunk)).collect();
    let mut features = Vec::with_capacity(sight.hypotheses.len());
    for input in &inputs {
        let mut outputs = bundle.coarse.run(&[("frame", input)]).map_err(failed)?;
        let cells = Dim::Exact(layout.cells);
        let count = input.shape.first().copied().unwrap_or(0);
        let all = outputs.take("frame_features", &[Dim::Exact(count), Dim::Any, cells, cells]).map_err(failed)?;
        let item = all.data.len() / count.max(1);
        let shape = [1].iter().chain(all.shape.iter().skip(1)).copied().collect::<Vec<_>>();
        features.extend(all.data.chunks_exact(item.max(1)).map(|data| Tensor { shape: shape.clone(), data: data.to_vec() }));
    }
    Ok(features)
}

fn failed(error: GraphError) -> NoFix {
    NoFix::new(Reason::NonFinite, error.to_string())
}

/// The map encoder on a square of map at the coarse input's metres per pixel: `[1, C, side / stride, side / stride]`.
pub fn encode(bundle: &mut Bundle, rgb: &[u8], size_px: usize) -> Result<Tensor, GraphError> {
    let (stride, rule) = match &bundle.manifest.coarse {
        StageManifest::Correlation(stage) => (stage.stride.max(1) as usize, stage.map.resize),
        StageManifest::Matcher(stage) => (1, stage.map.resize),
    };
    let input = Tensor { shape: vec![1, 3, size_px, size_px], data: resize_u8(rgb, size_px, 3, size_px, rule) };
    let cells = Dim::Exact(size_px / stride);
    bundle.coarse_map.run(&[("map", &input)])?.take("map_features", &[Dim::Exact(1), Dim::Any, cells, cells])
}

/// Whether tiles can stand for the whole: the encoder takes any size, and what lies further than the rim changes nothing.
pub fn features_belong_to_the_map(bundle: &mut Bundle) -> bool {
    let StageManifest::Correlation(stage) = &bundle.manifest.coarse else { return false };
    let (side, stride) = (2 * RIM_PX + 4 * ALIGN_PX, stage.stride as usize);
    if Layout::new(stage, BLOCK_CELLS, 1.0).is_none() {
        return false;
    }
    // Any picture with structure; the second differs from it beyond the rim about the middle 2 x 16 pixels.
    let value = |i: usize| (i.wrapping_mul(2_654_435_761) >> 7) as u8;
    let first: Vec<u8> = (0..side * side * 3).map(value).collect();
    let near = |v: usize| (ALIGN_PX..side - ALIGN_PX).contains(&v);
    let same = |i: usize| near(i / 3 % side) && near(i / 3 / side);
    let second: Vec<u8> = first.iter().enumerate().map(|(i, v)| if same(i) { *v } else { 255 - *v }).collect();
    let (Ok(a), Ok(b)) = (encode(bundle, &first, side), encode(bundle, &second, side)) else { return false };
    let cells = side / stride;
    let inner = |i: usize| ((RIM_PX + ALIGN_PX) / stride..(side - RIM_PX - ALIGN_PX) / stride).contains(&i);
    let largest = a.data.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    a.data.iter().zip(&b.data).enumerate().all(|(i, (a, b))| {
        let outside = !(inner(i % cells) && inner(i / cells % cells));
        outside || (a - b).abs() <= 1e-3 * largest
    })
}

#[cfg(test)]
mod tests;
