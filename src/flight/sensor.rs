//! The thermal camera of the simulator: a pinhole over flat ground, its optics and its faults, 14-bit counts.

use super::night::{NightField, raster};
use super::noise::{Dice, fbm};

/// Largest count.
pub const MAX_COUNT: u16 = (1 << 14) - 1;

/// The camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Horizontal field of view, degrees.
    pub hfov_deg: f64,
    /// Scales all noise; 1 is an uncooled camera of middling quality (80 mK).
    pub noise: f64,
}

/// Where the camera is and looks: the true pose. Its attitude is the camera's (FRD, ZYX, 0/0 looks down).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Height above ground, metres.
    pub agl_m: f64,
    /// Clockwise from true north to image up, degrees.
    pub yaw_deg: f64,
    /// Nose up positive, degrees.
    pub pitch_deg: f64,
    /// Right side down positive, degrees.
    pub roll_deg: f64,
}

impl Sensor {
    /// Ground metres per pixel at nadir.
    pub fn gsd_m(&self, agl_m: f64) -> f64 {
        2.0 * agl_m * (self.hfov_deg.to_radians() / 2.0).tan() / self.width as f64
    }

    /// Frame pixel -> ground offset from the point under the camera, east and north metres; a 3 x 3 homography,
    /// row-major, `[2][2] == 1` for a camera that sees the ground in its middle.
    ///
    /// A pixel looks along (-(v - cv)/f, (u - cu)/f, 1) in forward-right-down axes; R = Rz(yaw) Ry(pitch) Rx(roll)
    /// takes that to north-east-down, and the ray meets the ground at height / down.
    pub fn ground_homography(&self, view: &View) -> [[f64; 3]; 3] {
        let focal = self.width as f64 / 2.0 / (self.hfov_deg.to_radians() / 2.0).tan();
        let (cu, cv) = ((self.width as f64 - 1.0) / 2.0, (self.height as f64 - 1.0) / 2.0);
        let [(sy, cy), (sp, cp), (sr, cr)] = [view.yaw_deg, view.pitch_deg, view.roll_deg].map(|d| d.to_radians().sin_cos());
        let r = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ];
        // Columns: what u, v and 1 contribute to (north, east, down).
        let ned = r.map(|[f, right, down]| [right / focal, -f / focal, down - right * cu / focal + f * cv / focal]);
        let [north, east, down] = ned;
        let scale = |row: [f64; 3], by: f64| row.map(|v| v * by);
        let [_, _, w] = down;
        [scale(east, view.agl_m / w), scale(north, view.agl_m / w), scale(down, 1.0 / w)]
    }
}

/// Faults that stay with the camera for a flight.
#[derive(Debug, Clone)]
pub struct Faults {
    columns_k: Vec<f32>,
    shading_k: Vec<f32>,
    dead: Vec<(usize, u16)>,
    counts_per_k: f32,
    base: f32,
    drift_k: f32,
}

impl Faults {
    /// Draws them.
    pub fn draw(sensor: &Sensor, dice: &mut Dice) -> Self {
        let noise = sensor.noise as f32;
        let columns_k = (0..sensor.width).map(|_| dice.normal32(0.0, 0.05 * noise)).collect();
        let (corner_k, seed) = (dice.normal32(0.5, 0.4) * noise, dice.seed());
        let (cx, cy) = (sensor.width as f32 / 2.0, sensor.height as f32 / 2.0);
        let shading_k = (0..sensor.width * sensor.height)
            .map(|i| {
                let (x, y) = ((i % sensor.width) as f32, (i / sensor.width) as f32);
                let r2 = ((x - cx).powi(2) + (y - cy).powi(2)) / (cx * cx + cy * cy);
                corner_k * r2 + 0.25 * noise * fbm(x / 170.0, y / 170.0, 2, seed)
            })
            .collect();
        let dead = (0..dice.below(9))
            .map(|_| (dice.below(sensor.width * sensor.height), if dice.chance(0.5) { 0 } else { MAX_COUNT }))
            .collect();
        Self {
            columns_k,
            shading_k,
            dead,
            counts_per_k: dice.range32(32.0, 75.0),
            base: dice.range32(6600.0, 8400.0),
            drift_k: 0.0,
        }
    }
}

/// Takes one frame. `to_field` takes ground offsets (east, north metres) to pixels of the night field: an origin and
/// the steps per metre east and north. `motion_m` is how far the ground moves during exposure (east, north).
/// Pixels that look past the field show its mean.
pub fn expose(
    night: &NightField,
    sensor: &Sensor,
    view: &View,
    to_field: [[f64; 2]; 3],
    motion_m: [f64; 2],
    faults: &mut Faults,
    dice: &mut Dice,
) -> Vec<u16> {
    let h = sensor.ground_homography(view);
    let noise = sensor.noise as f32;
    faults.drift_k = 0.9 * faults.drift_k + dice.normal32(0.0, 0.25 * noise);
    let offset_k = faults.drift_k + dice.normal32(0.0, 0.15 * noise);
    let rows_k: Vec<f32> = (0..sensor.height).map(|_| dice.normal32(0.0, 0.02 * noise)).collect();
    let [origin, east, north] = to_field;
    let shots = [-0.4, 0.0, 0.4];
    let mut out = Vec::with_capacity(sensor.width * sensor.height);
    for (v, row_k) in rows_k.iter().enumerate() {
        for (u, column_k) in faults.columns_k.iter().enumerate() {
            let [e, n, w] = h.map(|[a, b, c]| a * u as f64 + b * v as f64 + c);
            let (mut sum, mut hits) = (0.0, 0.0);
            for shot in shots {
                let (e, n) = (e / w + shot * motion_m[0], n / w + shot * motion_m[1]);
                let x = origin[0] + e * east[0] + n * north[0];
                let y = origin[1] + e * east[1] + n * north[1];
                if let Some(t) = raster::sample(&night.celsius, night.size_px, night.size_px, x as f32, y as f32) {
                    sum += t;
                    hits += 1.0;
                }
            }
            let celsius: f32 = if hits > 0.0 { sum / hits } else { 17.0 };
            let shading = faults.shading_k.get(out.len()).copied().unwrap_or(0.0);
            let kelvin = celsius - 17.0 + offset_k + shading + column_k + row_k + dice.normal32(0.0, 0.08 * noise);
            out.push((faults.base + faults.counts_per_k * kelvin).round().clamp(0.0, f32::from(MAX_COUNT)) as u16);
        }
    }
    for &(index, value) in &faults.dead {
        if let Some(pixel) = out.get_mut(index) {
            *pixel = value;
        }
    }
    out
}

#[cfg(test)]
#[path = "sensor_tests.rs"]
mod tests;
