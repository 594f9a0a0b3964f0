//! Recovery, degeneracy and equality of the closed form with the SVD.

use super::*;
use proptest::prelude::*;

/// A homography of the kind the pipeline sees: turn, scale, shear, perspective of a 512 px frame, then a shift.
fn homographies() -> impl Strategy<Value = Homography> {
    (-3.1_f64..3.1, 0.2_f64..5.0, -0.3_f64..0.3, -6e-4_f64..6e-4, -6e-4_f64..6e-4, -3000.0_f64..3000.0, -3000.0_f64..3000.0)
        .prop_map(|(angle, scale, shear, p, q, tx, ty)| {
            let (sin, cos) = (scale * angle.sin(), scale * angle.cos());
            let about_centre = Homography([[1.0, 0.0, -255.5], [0.0, 1.0, -255.5], [0.0, 0.0, 1.0]]);
            let turn = Homography([[cos, -sin + shear * cos, 0.0], [sin, cos + shear * sin, 0.0], [p, q, 1.0]]);
            let shift = Homography([[1.0, 0.0, tx], [0.0, 1.0, ty], [0.0, 0.0, 1.0]]);
            shift.after(&turn).after(&about_centre)
        })
}

fn close(a: [f64; 2], b: [f64; 2], tolerance: f64) -> bool {
    (a[0] - b[0]).hypot(a[1] - b[1]) <= tolerance * (1.0 + b[0].hypot(b[1]))
}

fn corners() -> [[f64; 2]; 4] {
    Quad::edges(512).0
}

proptest! {
    #[test]
    fn four_points_recover_the_homography(h in homographies()) {
        let found = dlt(&corners(), &h.apply_quad(&Quad(corners())).0)?;
        for (x, y) in [(-0.5, -0.5), (100.0, 400.0), (255.5, 255.5), (511.5, 511.5)] {
            prop_assert!(close(found.apply(x, y), h.apply(x, y), 1e-9), "{found:?} {h:?}");
        }
        prop_assert_eq!(found.0[2][2], 1.0);
    }

    #[test]
    fn many_points_recover_the_homography(h in homographies(), points in prop::collection::vec(prop::array::uniform2(-0.5_f64..511.5), 1..40)) {
        let mut from = corners().to_vec();
        from.extend(points);
        let to: Vec<_> = from.iter().map(|p| h.apply(p[0], p[1])).collect();
        let found = dlt(&from, &to)?;
        for p in &from {
            prop_assert!(close(found.apply(p[0], p[1]), h.apply(p[0], p[1]), 1e-7), "{found:?} {h:?}");
        }
    }

    #[test]
    fn the_closed_form_equals_the_svd(h in homographies()) {
        let to = h.apply_quad(&Quad(corners())).0;
        let (from, _) = Normalisation::of(&corners())?;
        let (to, _) = Normalisation::of(&to)?;
        let as_four = |points: &[[f64; 2]]| <[[f64; 2]; 4]>::try_from(points).ok();
        let closed = as_four(&from).zip(as_four(&to)).and_then(|(from, to)| four_points(&from, &to)).ok_or(DltError::Degenerate)?;
        let svd = least_squares(&from, &to).ok_or(DltError::Degenerate)?;
        let (closed, svd) = (closed / closed.m33, svd / svd.m33);
        prop_assert!((closed - svd).norm() <= 1e-8 * closed.norm(), "{closed} {svd}");
    }

    #[test]
    fn the_inverse_undoes(h in homographies(), x in -0.5_f64..511.5, y in -0.5_f64..511.5) {
        if let Some(inverse) = h.inverse() {
            let [u, v] = h.apply(x, y);
            prop_assert!(close(inverse.apply(u, v), [x, y], 1e-6));
            prop_assert!(close(inverse.after(&h).apply(x, y), [x, y], 1e-6));
        }
    }

    #[test]
    fn after_is_the_order_of_application(a in homographies(), b in homographies(), x in -0.5_f64..511.5, y in -0.5_f64..511.5) {
        let [u, v] = b.apply(x, y);
        let step_by_step = a.apply(u, v);
        prop_assume!(step_by_step[0].hypot(step_by_step[1]) < 1e6);
        prop_assert!(close(a.after(&b).apply(x, y), step_by_step, 1e-6));
    }

    /// Any bit pattern: an error or finite numbers.
    #[test]
    fn ok_is_always_finite(pairs in prop::collection::vec(prop::array::uniform4(any::<f64>()), 0..9)) {
        let from: Vec<_> = pairs.iter().map(|p| [p[0], p[1]]).collect();
        let to: Vec<_> = pairs.iter().map(|p| [p[2], p[3]]).collect();
        if let Ok(h) = dlt(&from, &to) {
            prop_assert!(h.is_finite());
            prop_assert_eq!(h.0[2][2], 1.0);
        }
    }

    /// Points of a small grid: many of these sets are degenerate.
    #[test]
    fn ok_on_a_grid_takes_the_points_over(pairs in prop::collection::vec(prop::array::uniform4(0_i8..4), 4..5)) {
        let from: Vec<_> = pairs.iter().map(|p| [f64::from(p[0]), f64::from(p[1])]).collect();
        let to: Vec<_> = pairs.iter().map(|p| [f64::from(p[2]), f64::from(p[3])]).collect();
        if let Ok(h) = dlt(&from, &to) {
            for (p, q) in from.iter().zip(&to) {
                prop_assert!(close(h.apply(p[0], p[1]), *q, 1e-6), "{h:?}: {p:?} -> {q:?}");
            }
        }
    }

    #[test]
    fn points_on_a_line_are_an_error(ts in prop::collection::vec(-500.0_f64..500.0, 4..12), angle in 0.0_f64..6.3, shift in -500.0_f64..500.0) {
        let line: Vec<_> = ts.iter().map(|t| [shift + t * angle.cos(), t * angle.sin()]).collect();
        let spread: Vec<_> = (0..ts.len()).map(|i| [(i % 3) as f64 * 100.0, (i / 3) as f64 * 90.0 + (i * i) as f64]).collect();
        prop_assert_eq!(dlt(&line, &spread), Err(DltError::Degenerate));
        prop_assert_eq!(dlt(&spread, &line), Err(DltError::Degenerate));
    }
}

#[test]
fn what_cannot_be_solved_is_an_error() {
    let square = corners();
    assert_eq!(dlt(&square[..3], &square[..3]), Err(DltError::TooFew(3)));
    assert_eq!(dlt(&square, &square[..3]), Err(DltError::Unequal { from: 4, to: 3 }));
    assert_eq!(dlt(&[[1.0, 1.0]; 4], &square), Err(DltError::Degenerate));
    assert_eq!(dlt(&square, &[[1.0, 1.0]; 6][..4]), Err(DltError::Degenerate));
    let mut with_nan = square;
    with_nan[2][1] = f64::NAN;
    assert_eq!(dlt(&square, &with_nan), Err(DltError::Degenerate));
    // Three of four on a line.
    assert_eq!(dlt(&square, &[[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [5.0, 0.0]]), Err(DltError::Degenerate));
    // The origin goes to infinity: no h[2][2] == 1.
    assert_eq!(
        dlt(&[[1.0, 1.0], [2.0, 1.0], [1.0, 2.0], [2.0, 2.0]], &[[1.0, 1.0], [0.5, 0.5], [1.0, 2.0], [0.5, 1.0]]),
        Err(DltError::Degenerate)
    );
}

#[test]
fn more_points_average_noise_out() -> Result<(), DltError> {
    let from: Vec<_> = (0..100).map(|i| [f64::from(i % 10) * 50.0, f64::from(i / 10) * 50.0]).collect();
    // A fixed disturbance of +-0.5 px that no homography follows.
    let to: Vec<_> =
        (0..100).map(|i| [from[i][0] + 10.0 + if (i + i / 10) % 2 == 0 { 0.5 } else { -0.5 }, from[i][1] - 20.0]).collect();
    let h = dlt(&from, &to)?;
    assert!(close(h.apply(225.0, 225.0), [235.0, 205.0], 1e-3), "{h:?}");
    Ok(())
}

#[test]
fn no_inverse_of_a_singular_matrix() {
    assert_eq!(Homography([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]]).inverse(), None);
    assert_eq!(Homography([[f64::NAN; 3]; 3]).inverse(), None);
    assert_eq!(Homography::IDENTITY.inverse(), Some(Homography::IDENTITY));
}
