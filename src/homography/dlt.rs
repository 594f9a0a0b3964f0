//! The normalised direct linear transform.

/// A 3 x 3 homography, row-major, `h[2][2] == 1`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Homography(pub [[f64; 3]; 3]);

/// Why no homography came of the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DltError {
    /// Fewer than four pairs.
    #[error("homography: expected at least 4 point pairs, found {0}")]
    TooFew(usize),
    /// Collinear, coincident or non-finite points.
    #[error("homography: the points are degenerate or not finite")]
    Degenerate,
}

impl Homography {
    /// The identity.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    /// Applies it to a point.
    pub fn apply(&self, x: f64, y: f64) -> [f64; 2] {
        let h = &self.0;
        let w = h[2][0] * x + h[2][1] * y + h[2][2];
        [(h[0][0] * x + h[0][1] * y + h[0][2]) / w, (h[1][0] * x + h[1][1] * y + h[1][2]) / w]
    }
    /// `self` after `first`.
    pub fn after(&self, first: &Self) -> Self {
        let _ = first;
        todo!("homography")
    }
    /// The inverse, where there is one.
    pub fn inverse(&self) -> Option<Self> {
        todo!("homography")
    }
}

/// The homography that takes each `from` point to its `to` point: exact for four, least squares (normalised, SVD) for
/// more. Reference: Hartley & Zisserman, Multiple View Geometry, 2nd ed., Alg. 4.2.
pub fn dlt(from: &[[f64; 2]], to: &[[f64; 2]]) -> Result<Homography, DltError> {
    let _ = (from, to);
    todo!("homography")
}
