//! The procedural world: an invented piece of land that looks like a satellite picture and knows what covers it.
//!
//! Ground first, then fields, roads, settlements, plants and cars, in the order in which they hide each other. No
//! pattern repeats: everything is drawn from the seed. The same seed gives the same pixels.

mod canvas;
mod fields;
mod roads;
mod scatter;
mod terrain;
mod town;

pub use canvas::Cover;

use super::noise::Dice;
use canvas::{Canvas, P};

/// What to make.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldOptions {
    /// Seed.
    pub seed: u64,
    /// Side of the square, metres.
    pub size_m: f64,
    /// Metres per pixel.
    pub m_per_px: f64,
    /// Amplitude of the grain, grey levels (0 compresses best).
    pub grain: f64,
}

impl Default for WorldOptions {
    fn default() -> Self {
        Self { seed: 1, size_m: 4000.0, m_per_px: 1.0, grain: 3.0 }
    }
}

/// A made world.
#[derive(Debug, Clone)]
pub struct World {
    /// Side, pixels.
    pub size_px: usize,
    /// Metres per pixel.
    pub m_per_px: f64,
    /// Interleaved RGB, row-major, north up.
    pub rgb: Vec<u8>,
    /// Land cover, row-major: see [`Cover`].
    pub classes: Vec<u8>,
}

/// Makes a world.
pub fn make_world(options: &WorldOptions) -> World {
    let size_px = (options.size_m / options.m_per_px).round().max(1.0) as usize;
    let mut canvas = Canvas::new(size_px, size_px, options.m_per_px as f32);
    // One stream for each painter: a change in one leaves the draws of the others alone.
    let dice = |stream: u64| Dice::new(options.seed, stream);
    let land = terrain::paint(&mut canvas, &mut dice(1));
    fields::paint(&mut canvas, &mut dice(2), &land);

    let mut draw = dice(3);
    let sites = town::sites(canvas.size_m(), &land, &mut draw);
    let places: Vec<P> = sites.iter().map(|s| s.at).collect();
    let mut network = roads::plan(canvas.size_m(), &places, &mut draw);
    let mut taken = roads::Taken::new(canvas.size_m());
    for road in &network {
        taken.take_line(&road.line, road.half_m + 2.0);
    }
    let mut streets = Vec::new();
    for site in &sites {
        for road in town::streets(site, &land, &mut taken, &mut draw) {
            taken.take_line(&road.line, road.half_m + 0.5);
            streets.push((road, site.works));
        }
    }
    let mut brush = dice(4);
    network.extend(streets.iter().map(|(road, _)| road.clone()));
    for kind in [roads::Kind::Dirt, roads::Kind::Street, roads::Kind::Highway] {
        for road in network.iter().filter(|r| r.kind == kind) {
            roads::paint(&mut canvas, road, &land, &mut brush);
        }
    }
    for site in sites.iter().filter(|s| s.radius_m > 220.0) {
        if brush.chance(0.6) {
            roads::roundabout(&mut canvas, site.at, &mut brush);
        }
    }
    let mut builder = dice(5);
    for (road, works) in &streets {
        let density = builder.range32(0.6, 0.98);
        town::build(&mut canvas, road, *works, density, &land, &mut taken, &mut builder);
    }
    // Lone farms and works along the country roads.
    for road in network.iter().filter(|r| r.kind != roads::Kind::Highway) {
        let works = builder.chance(0.3);
        town::build(&mut canvas, road, works, 0.07, &land, &mut taken, &mut builder);
    }
    let [w, h] = canvas.size_m();
    for _ in 0..(f64::from(w * h) / 16e6 * 90.0) as usize {
        let near = builder.pick(&places, [w / 2.0, h / 2.0]);
        let at = [near[0] + builder.normal32(0.0, 330.0), near[1] + builder.normal32(0.0, 330.0)];
        town::lot(&mut canvas, at, &land, &mut taken, &mut builder);
    }
    let mut small = dice(6);
    scatter::plants(&mut canvas, &network, &land, &mut small);
    scatter::traffic(&mut canvas, &network, &mut small);
    scatter::grain(&mut canvas, options.grain as f32, &mut small);
    World { size_px, m_per_px: options.m_per_px, rgb: canvas.rgb.into_flattened(), classes: canvas.cover }
}

#[cfg(test)]
mod tests;
