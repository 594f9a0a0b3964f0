//! Plain image operations on row-major `f32` rasters.

/// Gaussian blur, separable, edges repeated. `sigma_px` under 0.2 changes nothing.
pub fn blur(image: &mut Vec<f32>, width: usize, height: usize, sigma_px: f32) {
    if sigma_px < 0.2 || width == 0 || height == 0 || image.len() != width * height {
        return;
    }
    let reach = (3.0 * sigma_px).ceil() as usize;
    let mut taps: Vec<f32> = (0..=reach).map(|i| (-0.5 * (i as f32 / sigma_px).powi(2)).exp()).collect();
    let sum: f32 = taps.iter().sum::<f32>() * 2.0 - 1.0;
    taps.iter_mut().for_each(|t| *t /= sum);
    let mut out = vec![0.0_f32; image.len()];
    // Along the rows, through a padded copy of each.
    let mut padded = vec![0.0_f32; width + 2 * reach];
    for (from, to) in image.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        let (first, last) = (from.first().copied().unwrap_or(0.0), from.last().copied().unwrap_or(0.0));
        padded.fill(first);
        padded.iter_mut().skip(reach + width).for_each(|v| *v = last);
        padded.iter_mut().skip(reach).zip(from).for_each(|(p, v)| *p = *v);
        for (k, tap) in taps.iter().enumerate() {
            for side in if k == 0 { vec![reach] } else { vec![reach - k, reach + k] } {
                to.iter_mut().zip(padded.iter().skip(side)).for_each(|(t, p)| *t += tap * p);
            }
        }
    }
    // Down the columns, whole rows at a time.
    image.fill(0.0);
    for (y, row) in image.chunks_exact_mut(width).enumerate() {
        for (k, tap) in taps.iter().enumerate() {
            let (up, down) = (y.saturating_sub(k), (y + k).min(height - 1));
            for source in if k == 0 { vec![y] } else { vec![up, down] } {
                let from = out.get(source * width..(source + 1) * width).unwrap_or(&[]);
                row.iter_mut().zip(from).for_each(|(t, v)| *t += tap * v);
            }
        }
    }
}

/// Labels 4-connected groups of set pixels: 0 where not set, else 1..=n. Returns the labels and n.
pub fn components(mask: impl Fn(usize) -> bool, width: usize, height: usize) -> (Vec<u32>, usize) {
    let mut labels = vec![0_u32; width * height];
    let (mut count, mut stack) = (0_u32, Vec::new());
    for start in 0..width * height {
        if labels.get(start) != Some(&0) || !mask(start) {
            continue;
        }
        count += 1;
        stack.push(start);
        while let Some(at) = stack.pop() {
            if labels.get(at) != Some(&0) || !mask(at) {
                continue;
            }
            if let Some(label) = labels.get_mut(at) {
                *label = count;
            }
            let x = at % width;
            if x > 0 {
                stack.push(at - 1);
            }
            if x + 1 < width {
                stack.push(at + 1);
            }
            if at >= width {
                stack.push(at - width);
            }
            if at + width < labels.len() {
                stack.push(at + width);
            }
        }
    }
    (labels, count as usize)
}

/// Middles of `k` colour clusters. Reference: Lloyd, IEEE Trans. Inf. Theory 28, 1982.
pub fn k_means(samples: &[[f32; 3]], mut middles: Vec<[f32; 3]>, rounds: usize) -> Vec<[f32; 3]> {
    for _ in 0..rounds {
        let mut sums = vec![([0.0_f64; 3], 0.0_f64); middles.len()];
        for s in samples {
            let nearest = middles.iter().enumerate().min_by(|a, b| gap(s, a.1).total_cmp(&gap(s, b.1))).map_or(0, |(i, _)| i);
            if let Some((sum, n)) = sums.get_mut(nearest) {
                sum.iter_mut().zip(s).for_each(|(t, v)| *t += f64::from(*v));
                *n += 1.0;
            }
        }
        for (middle, (sum, n)) in middles.iter_mut().zip(sums) {
            if n > 0.0 {
                *middle = sum.map(|v| (v / n) as f32);
            }
        }
    }
    middles
}

/// Squared distance of two colours.
pub fn gap(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
}

/// Bilinear sample; `None` outside.
pub fn sample(image: &[f32], width: usize, height: usize, x: f32, y: f32) -> Option<f32> {
    if !(x >= 0.0 && y >= 0.0 && x <= (width - 1) as f32 && y <= (height - 1) as f32) {
        return None;
    }
    let (ix, iy) = ((x as usize).min(width.saturating_sub(2)), (y as usize).min(height.saturating_sub(2)));
    let (tx, ty) = (x - ix as f32, y - iy as f32);
    let at = iy * width + ix;
    let (top, bottom) = (image.get(at..at + 2)?, image.get(at + width..at + width + 2)?);
    let (&[a, b], &[c, d]) = (top, bottom) else { return None };
    let (upper, lower) = (a + (b - a) * tx, c + (d - c) * tx);
    Some(upper + (lower - upper) * ty)
}
