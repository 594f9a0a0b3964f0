//! What the world is painted on: RGB and land cover, with anti-aliased shapes in metres from the top-left corner
//! (x east, y south).

/// Land-cover codes, as in `*_classes.tif`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Cover {
    /// Not said.
    Unlabelled = 0,
    /// Roofs.
    Building = 1,
    /// Sand, soil, rock, stubble.
    Bare = 2,
    /// Asphalt, tracks.
    Road = 3,
    /// Trees, crops, grass.
    Vegetation = 4,
    /// Rivers, lakes, pools.
    Water = 5,
}

/// A point or a vector, metres.
pub type P = [f32; 2];

/// Red, green, blue, 0..=255.
pub type Rgb = [f32; 3];

/// An image under construction.
#[derive(Debug, Clone)]
pub struct Canvas {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Metres per pixel.
    pub mpp: f32,
    /// Interleaved colours, row-major.
    pub rgb: Vec<[u8; 3]>,
    /// Land-cover codes, row-major.
    pub cover: Vec<u8>,
}

impl Canvas {
    /// An empty canvas.
    pub fn new(width: usize, height: usize, mpp: f32) -> Self {
        Self { width, height, mpp, rgb: vec![[0; 3]; width * height], cover: vec![0; width * height] }
    }
    /// Side lengths, metres.
    pub fn size_m(&self) -> P {
        [self.width as f32 * self.mpp, self.height as f32 * self.mpp]
    }
    /// Middle of a pixel, metres.
    pub fn middle(&self, x: usize, y: usize) -> P {
        [(x as f32 + 0.5) * self.mpp, (y as f32 + 0.5) * self.mpp]
    }
    /// Whether a place lies on the canvas.
    pub fn contains(&self, p: P) -> bool {
        let [w, h] = self.size_m();
        (0.0..w).contains(&p[0]) && (0.0..h).contains(&p[1])
    }
    /// Land cover at a place.
    pub fn cover_at(&self, p: P) -> Option<u8> {
        let index = self.contains(p).then(|| (p[1] / self.mpp) as usize * self.width + (p[0] / self.mpp) as usize)?;
        self.cover.get(index).copied()
    }
    /// Pixel rectangle (x0, x1, y0, y1; ends exclusive) of the box of `points` grown by `margin_m`, clipped.
    pub fn bounds(&self, points: &[P], margin_m: f32) -> (usize, usize, usize, usize) {
        let fold = |axis: usize| points.iter().fold((f32::MAX, f32::MIN), |(lo, hi), p| (lo.min(p[axis]), hi.max(p[axis])));
        let clip = |(lo, hi): (f32, f32), limit: usize| {
            let from = ((lo - margin_m) / self.mpp).floor().clamp(0.0, limit as f32) as usize;
            let to = ((hi + margin_m) / self.mpp).ceil().clamp(0.0, limit as f32) as usize;
            (from, to.max(from))
        };
        let ((x0, x1), (y0, y1)) = (clip(fold(0), self.width), clip(fold(1), self.height));
        (x0, x1, y0, y1)
    }
    /// Blends a colour into a pixel; from half coverage on the pixel takes the land cover.
    pub fn blend(&mut self, index: usize, colour: Rgb, alpha: f32, cover: Option<Cover>) {
        let Some(pixel) = self.rgb.get_mut(index) else { return };
        for (old, new) in pixel.iter_mut().zip(colour) {
            *old = (f32::from(*old) + (new - f32::from(*old)) * alpha).round().clamp(0.0, 255.0) as u8;
        }
        if let (Some(cover), true, Some(slot)) = (cover, alpha >= 0.5, self.cover.get_mut(index)) {
            *slot = cover as u8;
        }
    }
    /// Multiplies a pixel's colour (shadow, stain).
    pub fn shade(&mut self, index: usize, factor: f32) {
        if let Some(pixel) = self.rgb.get_mut(index) {
            for v in pixel.iter_mut() {
                *v = (f32::from(*v) * factor).round().clamp(0.0, 255.0) as u8;
            }
        }
    }
    /// Anti-aliased coverage of a shape whose edge lies `signed_m` away (negative inside).
    pub fn coverage(&self, signed_m: f32) -> f32 {
        (0.5 - signed_m / self.mpp).clamp(0.0, 1.0)
    }
    /// Paints every pixel within `margin_m` of the box of `points`: `f(place)` gives colour, coverage and cover.
    pub fn paint(&mut self, points: &[P], margin_m: f32, f: impl Fn(P) -> Option<(Rgb, f32, Option<Cover>)>) {
        let (x0, x1, y0, y1) = self.bounds(points, margin_m);
        for y in y0..y1 {
            for x in x0..x1 {
                if let Some((colour, alpha, cover)) = f(self.middle(x, y)) {
                    self.blend(y * self.width + x, colour, alpha, cover);
                }
            }
        }
    }
    /// Paints along a polyline: `f(distance from the line, arc length, place)`, up to `reach_m` from it. Each pixel is
    /// painted once, by its nearest segment.
    pub fn stroke(&mut self, line: &[P], reach_m: f32, f: impl Fn(f32, f32, P) -> Option<(Rgb, f32, Option<Cover>)>) {
        // Short pieces keep the boxes small; the nearest-segment rule needs the neighbours only.
        let mut along = 0.0;
        for (i, pair) in line.windows(2).enumerate() {
            let &[a, b] = pair else { continue };
            let length = distance(a, b);
            let (before, after) = (i.checked_sub(1).and_then(|k| line.get(k)), line.get(i + 2));
            let (x0, x1, y0, y1) = self.bounds(&[a, b], reach_m);
            for y in y0..y1 {
                for x in x0..x1 {
                    let p = self.middle(x, y);
                    let (signed, t) = to_segment(p, a, b);
                    let d = signed.abs();
                    let beaten = d > reach_m
                        || before.is_some_and(|&o| to_segment(p, o, a).0.abs() <= d)
                        || after.is_some_and(|&o| to_segment(p, b, o).0.abs() < d);
                    if !beaten && let Some((colour, alpha, cover)) = f(signed, along + t * length, p) {
                        self.blend(y * self.width + x, colour, alpha, cover);
                    }
                }
            }
            along += length;
        }
    }
}

/// Euclidean distance.
pub fn distance(a: P, b: P) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Distance of `p` from the segment (positive to its right, walking from `a` to `b` with y south), and where along it
/// (0..=1) the nearest point lies.
pub fn to_segment(p: P, a: P, b: P) -> (f32, f32) {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let t = (((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / (dx * dx + dy * dy).max(1e-9)).clamp(0.0, 1.0);
    let d = distance(p, [a[0] + t * dx, a[1] + t * dy]);
    let side = dx * (p[1] - a[1]) - dy * (p[0] - a[0]);
    (if side < 0.0 { -d } else { d }, t)
}

/// A smooth curve through the points (Catmull-Rom), in pieces of about `step_m`.
pub fn smooth(points: &[P], step_m: f32) -> Vec<P> {
    let get = |i: isize| points.get(i.clamp(0, points.len() as isize - 1) as usize).copied().unwrap_or([0.0; 2]);
    let mut out = Vec::new();
    for i in 0..points.len().saturating_sub(1) as isize {
        let (p0, p1, p2, p3) = (get(i - 1), get(i), get(i + 1), get(i + 2));
        let pieces = (distance(p1, p2) / step_m).ceil().clamp(1.0, 1000.0) as usize;
        for k in 0..pieces {
            let t = k as f32 / pieces as f32;
            let mut p = [0.0; 2];
            for (axis, v) in p.iter_mut().enumerate() {
                let (a, b, c, d) = (p0[axis], p1[axis], p2[axis], p3[axis]);
                *v = 0.5
                    * (2.0 * b
                        + (c - a) * t
                        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
                        + (3.0 * b - 3.0 * c + d - a) * t * t * t);
            }
            out.push(p);
        }
    }
    out.extend(points.last());
    out
}

/// A rectangle at any angle.
#[derive(Debug, Clone, Copy)]
pub struct Slab {
    /// Middle.
    pub centre: P,
    /// Half length, along `axis`.
    pub half_u: f32,
    /// Half width, across.
    pub half_v: f32,
    /// Unit vector along its length.
    pub axis: P,
}

impl Slab {
    /// Local coordinates: along, across.
    pub fn local(&self, p: P) -> P {
        let (dx, dy) = (p[0] - self.centre[0], p[1] - self.centre[1]);
        [dx * self.axis[0] + dy * self.axis[1], -dx * self.axis[1] + dy * self.axis[0]]
    }
    /// A place from local coordinates.
    pub fn place(&self, u: f32, v: f32) -> P {
        [self.centre[0] + u * self.axis[0] - v * self.axis[1], self.centre[1] + u * self.axis[1] + v * self.axis[0]]
    }
    /// Distance to its edge, metres, negative inside (box distance: exact along the sides).
    pub fn signed(&self, p: P) -> f32 {
        let [u, v] = self.local(p);
        (u.abs() - self.half_u).max(v.abs() - self.half_v)
    }
    /// Its corners.
    pub fn corners(&self) -> [P; 4] {
        let (u, v) = (self.half_u, self.half_v);
        [self.place(-u, -v), self.place(u, -v), self.place(u, v), self.place(-u, v)]
    }
    /// The same, wider on all sides.
    pub fn grown(&self, by: f32) -> Self {
        Self { half_u: self.half_u + by, half_v: self.half_v + by, ..*self }
    }
}
