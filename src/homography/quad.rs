//! Four corners, in the order TL, TR, BL, BR.

/// Corner displacements `[x|y][top|bottom][left|right]`, cumulative, in stage-input map pixels, from the identity
/// corners (0, 0) .. (R - 1, R - 1). Model bundle contract; `sthn-reference.md` 1.5.
pub type Displacement = [[[f64; 2]; 2]; 2];

/// Four points, TL, TR, BL, BR.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quad(pub [[f64; 2]; 4]);

impl Quad {
    /// Corners of the pixel square `0..=size-1` (inclusive corners).
    pub fn inclusive(size_px: usize) -> Self {
        let e = size_px as f64 - 1.0;
        Self([[0.0, 0.0], [e, 0.0], [0.0, e], [e, e]])
    }
    /// Outer edges of the pixel square: `-0.5 ..= size - 0.5`.
    pub fn edges(size_px: usize) -> Self {
        let (a, b) = (-0.5, size_px as f64 - 0.5);
        Self([[a, a], [b, a], [a, b], [b, b]])
    }
    /// Identity corners plus a displacement.
    pub fn displaced(size_px: usize, d: &Displacement) -> Self {
        let mut q = Self::inclusive(size_px);
        for (i, p) in q.0.iter_mut().enumerate() {
            p[0] += d[0][i / 2][i % 2];
            p[1] += d[1][i / 2][i % 2];
        }
        q
    }
    /// The mean of the corners.
    pub fn mean(&self) -> [f64; 2] {
        let s = self.0.iter().fold([0.0, 0.0], |s, p| [s[0] + p[0], s[1] + p[1]]);
        [s[0] / 4.0, s[1] / 4.0]
    }
}

/// Inclusive stage corners -> edges of window pixels at 1 m/px: left * alpha, (right + 1) * alpha, then - 0.5.
/// `alpha` = window pixels per stage pixel. A perfect fit then has scale 1.000 for every W_S.
pub fn box_of_inclusive(quad: &Quad, alpha: f64) -> Quad {
    let mut out = *quad;
    for (i, p) in out.0.iter_mut().enumerate() {
        let (right, bottom) = ((i % 2) as f64, (i / 2) as f64);
        p[0] = (p[0] + right) * alpha - 0.5;
        p[1] = (p[1] + bottom) * alpha - 0.5;
    }
    out
}
