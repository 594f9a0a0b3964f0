//! The normalised direct linear transform.

use super::Quad;
use nalgebra::{DMatrix, Matrix3, Vector3};

/// A 3 x 3 homography, row-major, `h[2][2] == 1`. It maps pixel coordinates to pixel coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Homography(pub [[f64; 3]; 3]);

/// Why no homography came of the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DltError {
    /// Fewer than four pairs.
    #[error("homography: expected at least 4 point pairs, found {0}")]
    TooFew(usize),
    /// The two lists differ in length.
    #[error("homography: expected as many points as the {from} of the first list, found {to}")]
    Unequal {
        /// Points in the first list.
        from: usize,
        /// Points in the second.
        to: usize,
    },
    /// Collinear, coincident or non-finite points, or a homography that cannot be scaled to `h[2][2] == 1`.
    #[error("homography: the points are degenerate or not finite")]
    Degenerate,
}

/// Triangles smaller than this (points scaled to a mean distance of sqrt 2 from their mean) count as collinear.
const MIN_TRIANGLE: f64 = 1e-9;
/// Determinants below this, of a matrix of norm 1 between normalised points, count as 0.
const MIN_DETERMINANT: f64 = 1e-10;
/// Share of the largest singular value below which the last but one says that the solution is not unique.
const MIN_RANK_RATIO: f64 = 1e-10;
/// The origin's third coordinate, as a share of that of the points' middle, below which it counts as infinitely far.
const MIN_ORIGIN_RATIO: f64 = 1e-10;
/// Bound on the sweeps of the SVD: far above what it needs, so that no input can hang it.
const MAX_SVD_SWEEPS: usize = 10_000;

impl Homography {
    /// The identity.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);

    /// Applies it to a point. A point on the line that it sends to infinity gives infinite or NaN coordinates.
    pub fn apply(&self, x: f64, y: f64) -> [f64; 2] {
        let h = &self.0;
        let w = h[2][0] * x + h[2][1] * y + h[2][2];
        [(h[0][0] * x + h[0][1] * y + h[0][2]) / w, (h[1][0] * x + h[1][1] * y + h[1][2]) / w]
    }

    /// Applies it to four corners.
    pub fn apply_quad(&self, quad: &Quad) -> Quad {
        Quad(quad.0.map(|[x, y]| self.apply(x, y)))
    }

    /// `self` after `first`: `(a.after(&b)).apply(p) == a.apply(b.apply(p))`. Where the product sends the origin to
    /// infinity it cannot be scaled to `h[2][2] == 1` and stays unscaled.
    pub fn after(&self, first: &Self) -> Self {
        let product = self.matrix() * first.matrix();
        Self::scaled(&product).unwrap_or_else(|| Self::of(&product))
    }

    /// The inverse, where there is one with `h[2][2] == 1`.
    pub fn inverse(&self) -> Option<Self> {
        let m = self.matrix();
        // Hadamard's bound makes the test free of scale.
        let bound: f64 = m.row_iter().map(|row| row.norm()).product();
        let det = m.determinant();
        if !det.is_finite() || det.abs() <= 1e-14 * bound {
            return None;
        }
        // The origin comes from infinity.
        if m.m11 * m.m22 == m.m12 * m.m21 {
            return None;
        }
        Self::scaled(&adjugate(&m))
    }

    /// Whether every entry is finite.
    pub fn is_finite(&self) -> bool {
        self.0.iter().flatten().all(|v| v.is_finite())
    }

    fn matrix(&self) -> Matrix3<f64> {
        let [a, b, c] = self.0;
        Matrix3::new(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])
    }

    fn of(m: &Matrix3<f64>) -> Self {
        Self([[m.m11, m.m12, m.m13], [m.m21, m.m22, m.m23], [m.m31, m.m32, m.m33]])
    }

    /// Divides by the last entry; `None` where that leaves a number that is not finite.
    fn scaled(m: &Matrix3<f64>) -> Option<Self> {
        let h = Self::of(&(m / m.m33));
        h.is_finite().then_some(Self([h.0[0], h.0[1], [h.0[2][0], h.0[2][1], 1.0]]))
    }
}

/// The homography that takes each `from` point to its `to` point: exact for four (in closed form), least squares of
/// the algebraic error (normalised, SVD) for more.
///
/// # Errors
/// Fewer than four pairs, lists of unequal length, points that are not finite, three of four (or all but one of more)
/// on a line. `Ok` holds finite numbers only.
///
/// Reference: Hartley & Zisserman, Multiple View Geometry, 2nd ed., Alg. 4.2.
pub fn dlt(from: &[[f64; 2]], to: &[[f64; 2]]) -> Result<Homography, DltError> {
    if from.len() != to.len() {
        return Err(DltError::Unequal { from: from.len(), to: to.len() });
    }
    if from.len() < 4 {
        return Err(DltError::TooFew(from.len()));
    }
    let (from, undo_from) = Normalisation::of(from)?;
    let (to, undo_to) = Normalisation::of(to)?;
    let normalised = match (<[_; 4]>::try_from(from.as_slice()), <[_; 4]>::try_from(to.as_slice())) {
        (Ok(from), Ok(to)) => four_points(&from, &to),
        _ => least_squares(&from, &to),
    }
    .ok_or(DltError::Degenerate)?;
    let h = undo_to.inverse() * normalised * undo_from.forward();
    // The third coordinate at the origin against that at the middle of the points: where the first vanishes, h[2][2] = 1
    // cannot hold, and a rounding error must not stand in for it.
    let at_middle = normalised.m33;
    let near = h.m33.abs() > MIN_ORIGIN_RATIO * at_middle.abs();
    Homography::scaled(&h).filter(|_| near).ok_or(DltError::Degenerate)
}

/// `p -> (p - mean) * scale`, so that points have mean 0 and mean distance sqrt 2. H&Z 4.4.4.
struct Normalisation {
    mean: [f64; 2],
    scale: f64,
}

impl Normalisation {
    fn of(points: &[[f64; 2]]) -> Result<(Vec<[f64; 2]>, Self), DltError> {
        let n = points.len() as f64;
        let mean = [points.iter().map(|p| p[0]).sum::<f64>() / n, points.iter().map(|p| p[1]).sum::<f64>() / n];
        let spread = points.iter().map(|p| (p[0] - mean[0]).hypot(p[1] - mean[1])).sum::<f64>() / n;
        let scale = std::f64::consts::SQRT_2 / spread;
        // Points that differ by less than their own rounding error are one point; NaN and overflow end here as well.
        let magnitude = mean[0].abs().max(mean[1].abs());
        let distinct = spread > 1e-9 * magnitude && scale.is_finite() && scale > 0.0;
        if !distinct {
            return Err(DltError::Degenerate);
        }
        let moved = points.iter().map(|p| [(p[0] - mean[0]) * scale, (p[1] - mean[1]) * scale]).collect();
        Ok((moved, Self { mean, scale }))
    }

    fn forward(&self) -> Matrix3<f64> {
        let (s, [x, y]) = (self.scale, self.mean);
        Matrix3::new(s, 0.0, -s * x, 0.0, s, -s * y, 0.0, 0.0, 1.0)
    }

    fn inverse(&self) -> Matrix3<f64> {
        let (s, [x, y]) = (1.0 / self.scale, self.mean);
        Matrix3::new(s, 0.0, x, 0.0, s, y, 0.0, 0.0, 1.0)
    }
}

/// Four points in closed form: both quads are images of the same projective basis (H&Z 2.3, ex. 2.10).
fn four_points(from: &[[f64; 2]; 4], to: &[[f64; 2]; 4]) -> Option<Matrix3<f64>> {
    Some(basis(to)? * adjugate(&basis(from)?))
}

/// The matrix that takes e1, e2, e3 and (1, 1, 1) to the four points; `None` where three of them are on a line.
fn basis(points: &[[f64; 2]; 4]) -> Option<Matrix3<f64>> {
    let [a, b, c, d] = points.map(|[x, y]| Vector3::new(x, y, 1.0));
    let twice_area = |a: &Vector3<f64>, b: &Vector3<f64>, c: &Vector3<f64>| a.dot(&b.cross(c));
    let weights = [twice_area(&d, &b, &c), twice_area(&a, &d, &c), twice_area(&a, &b, &d)];
    let smallest = weights.iter().fold(twice_area(&a, &b, &c).abs(), |least, w| least.min(w.abs()));
    // Written so that NaN fails.
    (smallest > MIN_TRIANGLE).then(|| Matrix3::from_columns(&[a * weights[0], b * weights[1], c * weights[2]]))
}

/// Any number of points from five: the right singular vector of the smallest singular value.
fn least_squares(from: &[[f64; 2]], to: &[[f64; 2]]) -> Option<Matrix3<f64>> {
    // A 9 x 9 matrix at least, so that V has all nine vectors.
    let rows = (2 * from.len()).max(9);
    let mut a = DMatrix::<f64>::zeros(rows, 9);
    for (i, (&[x, y], &[u, v])) in from.iter().zip(to).enumerate() {
        let equations = [[-x, -y, -1.0, 0.0, 0.0, 0.0, u * x, u * y, u], [0.0, 0.0, 0.0, -x, -y, -1.0, v * x, v * y, v]];
        for (j, equation) in equations.iter().enumerate() {
            a.row_mut(2 * i + j).copy_from_slice(equation);
        }
    }
    let svd = a.try_svd(false, true, f64::EPSILON, MAX_SVD_SWEEPS)?;
    let v_t = svd.v_t?;
    let mut order: Vec<usize> = (0..svd.singular_values.len()).collect();
    order.sort_by(|&i, &j| svd.singular_values[i].total_cmp(&svd.singular_values[j]));
    let (&least, &next, &largest) = (order.first()?, order.get(1)?, order.last()?);
    let unique = svd.singular_values[next] > MIN_RANK_RATIO * svd.singular_values[largest];
    let h = Matrix3::from_row_iterator(v_t.row(least).iter().copied());
    (unique && h.determinant().abs() > MIN_DETERMINANT).then_some(h)
}

/// The inverse up to scale.
fn adjugate(m: &Matrix3<f64>) -> Matrix3<f64> {
    let (a, b, c) = (m.column(0).into_owned(), m.column(1).into_owned(), m.column(2).into_owned());
    Matrix3::from_rows(&[b.cross(&c).transpose(), c.cross(&a).transpose(), a.cross(&b).transpose()])
}

#[cfg(test)]
#[path = "dlt_tests.rs"]
mod tests;
