//! Light for the texels that no surface covers, so that filters never read black next to a chart.

use super::LightmapPage;
use rayon::prelude::*;

type Rgb = [f32; 3];

/// Fills the texels without coverage of `irradiance`, that of groups, `half_difference` and `back`: `gutter` rings around the
/// charts with the mean of their known neighbours, and all the rest from a pyramid of means (push-pull: Gortler et al., "The
/// Lumigraph", 1996, section 3.4.1), so that every mip level shows the mean of what is covered nearby.
///
/// What stands in uncovered texels is never read: the result depends on covered texels only. A page without
/// any covered texel becomes black. What does not have `width * height` entries, as `back` may, is left
/// as it is.
pub fn fill_gutters(page: &mut LightmapPage, gutter: u32) {
    let (width, height) = (page.width as usize, page.height as usize);
    let n = width * height;
    if n == 0 || page.coverage.len() != n {
        return;
    }
    let known: Vec<bool> = page.coverage.iter().map(|&c| c > 0.0).collect();
    let groups = page.groups.iter_mut().map(|g| &mut g.irradiance);
    for image in [&mut page.irradiance, &mut page.half_difference, &mut page.back].into_iter().chain(groups) {
        if image.len() == n {
            let mut known = known.clone();
            image.par_iter_mut().zip(&known).filter(|(_, k)| !**k).for_each(|(t, _)| *t = [0.0; 3]);
            grow_rings(image, &mut known, width, height, gutter);
            push_pull(image, &known, width, height);
        }
    }
}

/// Adds `rings` rings of texels around the known ones. A ring is computed from the state before it, so its
/// order does not matter.
fn grow_rings(image: &mut [Rgb], known: &mut [bool], width: usize, height: usize, rings: u32) {
    let neighbours = |i: usize| {
        let (x, y) = (i % width, i / width);
        let (x0, x1) = (x.saturating_sub(1), (x + 1).min(width - 1));
        (y.saturating_sub(1)..=(y + 1).min(height - 1)).flat_map(move |y| (x0..=x1).map(move |x| y * width + x))
    };
    let mut ring: Vec<usize> =
        (0..known.len()).into_par_iter().filter(|&i| !known[i] && neighbours(i).any(|j| known[j])).collect();
    let mut listed = vec![false; known.len()];
    for _ in 0..rings {
        let values: Vec<Rgb> =
            ring.par_iter().map(|&i| mean(neighbours(i).filter(|&j| known[j]).map(|j| image[j]))).collect();
        for (&i, value) in ring.iter().zip(values) {
            image[i] = value;
            known[i] = true;
        }
        let mut next = Vec::new();
        for &i in &ring {
            for j in neighbours(i) {
                if !known[j] && !listed[j] {
                    listed[j] = true;
                    next.push(j);
                }
            }
        }
        ring = next;
    }
}

/// Fills what is still unknown from coarser levels, in each of which a texel is the mean of its known
/// children.
fn push_pull(image: &mut [Rgb], known: &[bool], width: usize, height: usize) {
    if known.iter().all(|&k| k) || !known.iter().any(|&k| k) {
        return;
    }
    let (w, h) = (width.div_ceil(2), height.div_ceil(2));
    let mut coarse = vec![[0.0; 3]; w * h];
    let mut coarse_known = vec![false; w * h];
    for (i, (value, is_known)) in coarse.iter_mut().zip(&mut coarse_known).enumerate() {
        let (x, y) = (i % w * 2, i / w * 2);
        let children = (y..(y + 2).min(height)).flat_map(|y| (x..(x + 2).min(width)).map(move |x| y * width + x));
        *is_known = children.clone().any(|j| known[j]);
        *value = mean(children.filter(|&j| known[j]).map(|j| image[j]));
    }
    push_pull(&mut coarse, &coarse_known, w, h);
    for (i, value) in image.iter_mut().enumerate().filter(|(i, _)| !known[*i]) {
        *value = coarse[(i / width / 2) * w + i % width / 2];
    }
}

/// Mean of some values; black without any.
fn mean(values: impl Iterator<Item = Rgb>) -> Rgb {
    let (mut sum, mut n) = ([0.0f64; 3], 0u32);
    for v in values {
        n += 1;
        for c in 0..3 {
            sum[c] += f64::from(v[c]);
        }
    }
    sum.map(|s| (s / f64::from(n.max(1))) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A page with `value` at the given texels and poison everywhere else.
    fn page(width: u32, height: u32, covered: &[(usize, Rgb)]) -> LightmapPage {
        let n = (width * height) as usize;
        let mut page = LightmapPage { width, height, ..Default::default() };
        page.irradiance = vec![[f32::NAN, 1e30, -5.0]; n];
        page.coverage = vec![0.0; n];
        for &(i, value) in covered {
            page.irradiance[i] = value;
            page.coverage[i] = 0.25;
        }
        page
    }

    #[test]
    fn rings_take_the_mean_of_known_neighbours() {
        let mut p = page(5, 1, &[(0, [1.0; 3]), (4, [3.0; 3])]);
        fill_gutters(&mut p, 2);
        assert_eq!(p.irradiance, [[1.0; 3], [1.0; 3], [2.0; 3], [3.0; 3], [3.0; 3]]);
    }

    #[test]
    fn covered_texels_stay_and_uncovered_ones_are_never_read() {
        let covered = [(9, [1.0, 2.0, 3.0]), (70, [4.0, 5.0, 6.0])];
        for gutter in [0, 1, 4, 100] {
            let mut p = page(13, 9, &covered);
            fill_gutters(&mut p, gutter);
            assert!(covered.iter().all(|&(i, v)| p.irradiance[i] == v));
            assert!(p.irradiance.iter().all(|t| (0..3).all(|c| t[c] >= covered[0].1[c] && t[c] <= covered[1].1[c])));
        }
    }

    #[test]
    fn the_rest_of_the_page_shows_the_mean_on_the_coarsest_mip() {
        let mut p = page(8, 8, &[(0, [1.0; 3]), (63, [3.0; 3])]);
        fill_gutters(&mut p, 0);
        assert_eq!(p.irradiance[1], [1.0; 3]);
        assert_eq!(p.irradiance[7], [2.0; 3], "a quadrant without charts is the mean of the page");
    }

    #[test]
    fn an_empty_page_is_black_and_odd_vectors_are_left_alone() {
        let mut p = page(4, 4, &[]);
        fill_gutters(&mut p, 4);
        assert!(p.irradiance.iter().all(|t| *t == [0.0; 3]));
        let mut p = LightmapPage { width: 4, height: 4, ..Default::default() };
        fill_gutters(&mut p, 4);
        assert!(p.irradiance.is_empty());
    }
}
