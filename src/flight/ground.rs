//! The ground under a simulated camera: a square of a map, its land cover, and the geometry between them.

use super::classes;
use super::night::{self, Scene};
use super::sensor::{Sensor, View};
use super::simulate::SimulateError;
use super::trajectory::Waypoint;
use crate::geo::{Affine, Enu, LatLon};
use crate::map::{GeoTiff, MapCache, WindowSpec};
use std::path::Path;

/// Side of the square that counts as the footprint, metres.
const FOOTPRINT_M: f64 = 512.0;
/// Decoded tiles kept while the scene is read.
const CACHE_BYTES: usize = 256 << 20;

/// The map under the flight.
pub struct Ground {
    /// Picture, validity, land cover.
    pub scene: Scene,
    /// Where it lies.
    pub window: WindowSpec,
    /// File name of the map.
    pub map_name: String,
    /// Whether land cover came from a file.
    pub has_classes: bool,
}

impl Ground {
    /// Reads the square from a map with its land cover (`classes`; `<map>_classes.tif` beside it where that is absent).
    pub fn read(map: GeoTiff, path: &Path, classes: Option<&Path>, window: &WindowSpec) -> Result<Self, SimulateError> {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let beside = path.with_file_name(format!("{stem}_classes.tif"));
        let classes_path = classes.map(Path::to_owned).or_else(|| beside.is_file().then_some(beside));
        let codes = match &classes_path {
            Some(p) => Some(classes::read(p, map.size_px()).map_err(|why| SimulateError::File { path: p.clone(), why })?),
            None => None,
        };
        let (size_px, affine, map_name) = (map.size_px(), *map.affine(), map.name().to_owned());
        let pixels = MapCache::new(map, CACHE_BYTES).window(window)?;
        let m_per_px = window.m_per_px as f32;
        let mut cover = night::guess_cover(&pixels.rgb, pixels.size_px, m_per_px);
        if let Some(codes) = &codes {
            read_cover(&mut cover, codes, size_px, &affine, &Affine(pixels.map_affine), pixels.size_px);
        }
        let scene = Scene { size_px: pixels.size_px, m_per_px, rgb: pixels.rgb.clone(), valid: pixels.valid.clone(), cover };
        Ok(Self { scene, window: *window, map_name, has_classes: codes.is_some() })
    }

    /// Scene pixel -> position.
    pub fn position(&self, x: f64, y: f64) -> LatLon {
        let middle = (self.scene.size_px as f64 - 1.0) / 2.0;
        let m = self.window.m_per_px;
        self.window.centre.offset(Enu { east_m: (x - middle) * m, north_m: (middle - y) * m })
    }

    /// Position -> scene pixel.
    pub fn pixel(&self, at: LatLon) -> [f64; 2] {
        let middle = (self.scene.size_px as f64 - 1.0) / 2.0;
        let offset = self.window.centre.enu_to(at);
        [middle + offset.east_m / self.window.m_per_px, middle - offset.north_m / self.window.m_per_px]
    }

    /// Scene pixel of a position, and the scene pixels per metre towards its own true east and north (meridians
    /// converge over the area).
    pub fn local_axes(&self, at: LatLon) -> [[f64; 2]; 3] {
        let origin = self.pixel(at);
        let axis = |by: Enu| {
            let end = self.pixel(at.offset(by));
            [(end[0] - origin[0]) / 200.0, (end[1] - origin[1]) / 200.0]
        };
        [origin, axis(Enu { east_m: 200.0, north_m: 0.0 }), axis(Enu { east_m: 0.0, north_m: 200.0 })]
    }

    /// Whether the whole frame looks at valid map.
    pub fn holds(&self, waypoint: &Waypoint, view: &View, sensor: &Sensor) -> bool {
        let h = sensor.ground_homography(view);
        let m = self.window.m_per_px;
        (0..=8).all(|i| {
            (0..=8).all(|j| {
                let (u, v) =
                    (f64::from(i) / 8.0 * (sensor.width as f64 - 1.0), f64::from(j) / 8.0 * (sensor.height as f64 - 1.0));
                let [e, n, w] = h.map(|[a, b, c]| a * u + b * v + c);
                w > 0.0 && self.at(&self.scene.valid, waypoint.x + e / w / m, waypoint.y - n / w / m) == Some(1)
            })
        })
    }

    /// Share of water under the 512 m square about the truth, turned by the true yaw.
    pub fn water_share(&self, waypoint: &Waypoint, yaw_deg: f64) -> f64 {
        let (sin, cos) = yaw_deg.to_radians().sin_cos();
        let m = self.window.m_per_px;
        let (mut water, mut all) = (0_u32, 0_u32);
        for i in 0..128 {
            for j in 0..128 {
                let [u, v] = [i, j].map(|k| ((f64::from(k) + 0.5) / 128.0 - 0.5) * FOOTPRINT_M);
                let code = self.at(&self.scene.cover, waypoint.x + (cos * u - sin * v) / m, waypoint.y + (sin * u + cos * v) / m);
                water += u32::from(code == Some(5));
                all += 1;
            }
        }
        f64::from(water) / f64::from(all)
    }

    /// The nearest value of a scene raster.
    fn at(&self, raster: &[u8], x: f64, y: f64) -> Option<u8> {
        let (x, y, n) = (x.round(), y.round(), self.scene.size_px);
        let inside = x >= 0.0 && y >= 0.0 && x < n as f64 && y < n as f64;
        inside.then(|| raster.get(y as usize * n + x as usize).copied()).flatten()
    }
}

/// Lays the land-cover map over the guess, wherever it says something.
fn read_cover(cover: &mut [u8], codes: &[u8], size_px: (u32, u32), map: &Affine, window: &Affine, n: usize) {
    let Some(to_map) = map.inverse() else { return };
    for (i, slot) in cover.iter_mut().enumerate() {
        let (x, y) = window.apply((i % n) as f64, (i / n) as f64);
        let (px, py) = to_map.apply(x, y);
        let (px, py) = (px.round(), py.round());
        if px >= 0.0 && py >= 0.0 && px < f64::from(size_px.0) && py < f64::from(size_px.1) {
            match codes.get(py as usize * size_px.0 as usize + px as usize) {
                Some(code @ 1..=5) => *slot = *code,
                // Unlabelled: the guess stands, but not as water, which is always labelled where a class map exists.
                _ if *slot == 5 => *slot = 0,
                _ => {}
            }
        }
    }
}
