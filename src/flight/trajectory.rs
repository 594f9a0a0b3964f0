//! Where a simulated flight goes.

use super::noise::Dice;

/// The kind of flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Trajectory {
    /// Independent places, uniform where the whole footprint lies on the map.
    Random,
    /// Parallel lanes over the whole area.
    Lawnmower,
    /// One straight line.
    Line,
}

/// Which way image up points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Heading {
    /// Uniform, each frame anew.
    Random,
    /// Along the track.
    Track,
    /// North.
    North,
}

/// A place on the way: scene pixels, and the direction of travel (degrees clockwise from north).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Waypoint {
    /// Scene pixel.
    pub x: f64,
    /// Scene pixel.
    pub y: f64,
    /// Direction of travel.
    pub track_deg: f64,
    /// Metres from the start along the way.
    pub along_m: f64,
}

/// `count` evenly spaced places along lanes `lane_m` apart over the rectangle (x0, x1, y0, y1), scene pixels.
pub fn lawnmower(rect: (f64, f64, f64, f64), m_per_px: f64, lane_m: f64, count: usize) -> Vec<Waypoint> {
    let (x0, x1, y0, y1) = rect;
    let lanes = (((y1 - y0) * m_per_px / lane_m).floor() as usize + 1).max(2);
    let mut corners = Vec::new();
    for lane in 0..lanes {
        let y = y0 + (y1 - y0) * lane as f64 / (lanes - 1) as f64;
        let (from, to) = if lane % 2 == 0 { (x0, x1) } else { (x1, x0) };
        corners.extend([[from, y], [to, y]]);
    }
    along(&corners, m_per_px, count)
}

/// `count` evenly spaced places on a straight line across the rectangle.
pub fn line(rect: (f64, f64, f64, f64), m_per_px: f64, count: usize, dice: &mut Dice) -> Vec<Waypoint> {
    let (x0, x1, y0, y1) = rect;
    let side = dice.chance(0.5);
    let (a, b) = (dice.unit(), dice.unit());
    let ends = if side {
        [[x0, y0 + a * (y1 - y0)], [x1, y0 + b * (y1 - y0)]]
    } else {
        [[x0 + a * (x1 - x0), y1], [x0 + b * (x1 - x0), y0]]
    };
    along(&ends, m_per_px, count)
}

/// Evenly spaced places along a polyline, both ends included.
fn along(corners: &[[f64; 2]], m_per_px: f64, count: usize) -> Vec<Waypoint> {
    let legs: Vec<([f64; 2], [f64; 2], f64)> = corners
        .windows(2)
        .filter_map(|pair| match pair {
            &[a, b] => Some((a, b, (b[0] - a[0]).hypot(b[1] - a[1]))),
            _ => None,
        })
        .filter(|leg| leg.2 > 0.0)
        .collect();
    let total: f64 = legs.iter().map(|l| l.2).sum();
    (0..count)
        .filter_map(|i| {
            let at = total * i as f64 / (count.max(2) - 1) as f64;
            let mut left = at;
            let (a, b, length) = *legs.iter().find(|leg| {
                let here = left <= leg.2 + 1e-9;
                if !here {
                    left -= leg.2;
                }
                here
            })?;
            let t = (left / length).clamp(0.0, 1.0);
            let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
            let track_deg = dx.atan2(-dy).to_degrees().rem_euclid(360.0);
            Some(Waypoint { x: a[0] + t * dx, y: a[1] + t * dy, track_deg, along_m: at * m_per_px })
        })
        .collect()
}
