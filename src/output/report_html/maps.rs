//! Pictures of the pages: error, density and cells in false colours, small enough to be part of a file.

use crate::atlas::Texels;
use crate::bake::Bake;
use crate::cell::NO_CELL;
use crate::error::BakeError;
use crate::lightmap::LightmapPage;
use crate::output::preview::RgbImage;
use crate::sampling::hash_mix;
use crate::solve::Solution;
use base64::Engine;
use image::codecs::png::FilterType;
use rayon::prelude::*;

/// Pages that are shown, at most.
const MOST_PAGES: usize = 8;

/// Pixels of the longer side of a picture, at most.
const MOST_PIXELS: u32 = 512;

/// Bytes of all pictures together, at most, as text in the file.
const MOST_BYTES: usize = 7 << 19;

/// Where there is no surface.
const EMPTY: [u8; 3] = [38, 40, 46];

/// Where there is surface without a cell.
const NO_CELL_COLOUR: [u8; 3] = [250, 250, 250];

/// Colours of cells differ in which of these each channel has.
const CELL_LEVELS: [u8; 4] = [70, 130, 190, 235];

/// Errors from this share of the target to as many times it have colours of their own.
pub const ERROR_RANGE: f64 = 4.0;

/// Colours of errors, from the least to the largest: white at the target.
const ERROR_COLOURS: [[u8; 3]; 5] = [[33, 102, 172], [128, 184, 217], [247, 247, 247], [240, 150, 115], [178, 24, 43]];

/// Colours of densities, from the least to the largest.
const DENSITY_COLOURS: [[u8; 3]; 5] = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/// Shades of a scale: few, so that noise stays small as a PNG.
const SHADES: f64 = 24.0;

/// Pictures of the first pages.
pub struct Maps {
    /// As many as the file has room for.
    pub pages: Vec<PageMaps>,
    /// Texels per metre that have the first and the last colour.
    pub density: [f64; 2],
}

/// Pictures of one page, as data URIs of PNG files.
pub struct PageMaps {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Texels per pixel along each axis.
    pub step: u32,
    /// Error of the texels.
    pub error: String,
    /// Their density.
    pub density: String,
    /// Their cells; `None` where none are made.
    pub cells: Option<String>,
}

/// The maps of a bake. `target` is the error that is white, as a share of E.
///
/// # Errors
/// [`BakeError::Options`] where a page has no texels.
pub fn maps(bake: &Bake, target: f64) -> Result<Maps, BakeError> {
    let pages = &bake.lightmap.pages[..bake.lightmap.pages.len().min(MOST_PAGES)];
    let floor = (0.01 * bake.report.mean_irradiance) as f32;
    let grids: Vec<Grid> = pages.iter().map(Grid::new).collect();
    let pixels: Vec<Vec<Pixel>> = pages.iter().zip(&grids).map(|(p, g)| g.pixels(p, floor)).collect();
    let density = density_range(&pixels);
    let cells = cell_colours(&bake.texels, &bake.solution, pages, &grids);
    let page = |i: usize| {
        let grid = &grids[i];
        let error = |p: &Pixel| error_colour(p.error() / target);
        let density = |p: &Pixel| density_colour(p.density(), density);
        let ((error, density), cells) = rayon::join(
            || rayon::join(|| grid.uri(pixels[i].iter().map(error)), || grid.uri(pixels[i].iter().map(density))),
            || cells.get(i).map(|c| grid.uri(c.iter().copied())).transpose(),
        );
        let size = [grid.width, grid.height];
        Ok(PageMaps { size, step: grid.step, error: error?, density: density?, cells: cells? })
    };
    let mut pages = (0..pages.len()).into_par_iter().map(page).collect::<Result<Vec<PageMaps>, BakeError>>()?;
    let mut bytes = 0;
    let fit = pages.iter().take_while(|p| {
        bytes += p.error.len() + p.density.len() + p.cells.as_ref().map_or(0, String::len);
        bytes <= MOST_BYTES
    });
    let fit = fit.count();
    pages.truncate(fit);
    Ok(Maps { pages, density })
}

/// The colours of errors as a CSS gradient.
pub fn error_gradient() -> String {
    gradient(&ERROR_COLOURS)
}

/// The colours of densities as a CSS gradient.
pub fn density_gradient() -> String {
    gradient(&DENSITY_COLOURS)
}

/// Squares of texels, one per pixel.
struct Grid {
    width: u32,
    height: u32,
    /// Texels of a square along each axis.
    step: u32,
}

/// Sums over the texels of a pixel.
#[derive(Clone, Copy, Default)]
struct Pixel {
    /// Surface area (m2).
    area: f32,
    /// Texels inside charts.
    coverage: f32,
    /// Area times squared relative error.
    square: f32,
}

impl Pixel {
    /// RMS of the relative errors; NaN without surface.
    fn error(&self) -> f64 {
        f64::from(self.square / self.area).sqrt()
    }

    /// Texels per metre; NaN without surface.
    fn density(&self) -> f64 {
        f64::from(self.coverage / self.area).sqrt()
    }
}

impl Grid {
    fn new(page: &LightmapPage) -> Grid {
        let step = page.width.max(page.height).div_ceil(MOST_PIXELS).max(1);
        Grid { width: page.width.div_ceil(step), height: page.height.div_ceil(step), step }
    }

    /// Errors are relative to the larger of E and `floor` (lux).
    fn pixels(&self, page: &LightmapPage, floor: f32) -> Vec<Pixel> {
        let (width, step) = (page.width as usize, self.step as usize);
        let mut pixels = vec![Pixel::default(); (self.width * self.height) as usize];
        pixels.par_chunks_mut(self.width.max(1) as usize).enumerate().for_each(|(row, pixels)| {
            let rows = row * step..((row + 1) * step).min(page.height as usize);
            for (i, x) in rows.flat_map(|y| (0..width).map(move |x| (y * width + x, x))) {
                let area = page.area[i];
                if area > 0.0 {
                    let e = (page.irradiance[i].iter().sum::<f32>() / 3.0).max(floor);
                    let square = page.half_difference[i].iter().map(|d| d * d).sum::<f32>() / 3.0;
                    let pixel = &mut pixels[x / step];
                    pixel.area += area;
                    pixel.coverage += page.coverage[i];
                    pixel.square += if e > 0.0 { area * square / (e * e) } else { 0.0 };
                }
            }
        });
        pixels
    }

    /// A picture as a data URI.
    fn uri(&self, colours: impl Iterator<Item = [u8; 3]>) -> Result<String, BakeError> {
        let image = RgbImage { width: self.width, height: self.height, rgb: colours.flatten().collect() };
        let png = image.to_filtered_png(FilterType::NoFilter)?;
        Ok(data_uri(&png))
    }
}

/// A PNG file as an address that holds it.
pub(super) fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

/// Colour of each pixel's cell, per page; empty where no cells are made.
fn cell_colours(texels: &Texels, solution: &Solution, pages: &[LightmapPage], grids: &[Grid]) -> Vec<Vec<[u8; 3]>> {
    if solution.cell_of.is_empty() {
        return Vec::new();
    }
    let mut out: Vec<Vec<[u8; 3]>> = grids.iter().map(|g| vec![EMPTY; (g.width * g.height) as usize]).collect();
    for (i, t) in texels.texels[..texels.mapped].iter().enumerate().filter(|(i, _)| solution.weights.stored[*i]) {
        let (page, x, y) = texels.page_position(i);
        if page < pages.len() && (!t.back || pages[page].back.is_empty()) {
            let grid = &grids[page];
            let pixel = &mut out[page][(y / grid.step * grid.width + x / grid.step) as usize];
            if *pixel == EMPTY {
                *pixel = cell_colour(solution.cell_of[i]);
            }
        }
    }
    out
}

fn cell_colour(cell: u32) -> [u8; 3] {
    let bits = hash_mix(u64::from(cell), 1) as usize;
    let colour = std::array::from_fn(|c| CELL_LEVELS[(bits >> (2 * c)) % CELL_LEVELS.len()]);
    if cell == NO_CELL { NO_CELL_COLOUR } else { colour }
}

/// Texels per metre that all but a hundredth of the pixels are above, and below.
fn density_range(pages: &[Vec<Pixel>]) -> [f64; 2] {
    let mut all: Vec<f64> = pages.iter().flatten().map(Pixel::density).filter(|d| d.is_finite() && *d > 0.0).collect();
    if all.is_empty() {
        return [1.0, 2.0];
    }
    let n = all.len();
    let mut at = |k: usize| *all.select_nth_unstable_by(k, f64::total_cmp).1;
    let [low, high] = [at(n / 100), at(n - 1 - n / 100)];
    // A single density stands in the middle of the scale.
    let middle = (low * high).sqrt();
    [low.min(middle / 1.2), high.max(middle * 1.2)]
}

/// Colour of an error as a multiple of the target.
fn error_colour(ratio: f64) -> [u8; 3] {
    let t = 0.5 + 0.5 * ratio.ln() / ERROR_RANGE.ln();
    colour(&ERROR_COLOURS, t)
}

fn density_colour(density: f64, [low, high]: [f64; 2]) -> [u8; 3] {
    colour(&DENSITY_COLOURS, (density / low).ln() / (high / low).ln())
}

/// A colour of a scale, `t` in [0, 1]; that of emptiness where `t` is not a number.
fn colour(scale: &[[u8; 3]], t: f64) -> [u8; 3] {
    if t.is_nan() {
        return EMPTY;
    }
    let t = (t.clamp(0.0, 1.0) * SHADES).round() / SHADES * (scale.len() - 1) as f64;
    let i = (t as usize).min(scale.len() - 2);
    let part = t - i as f64;
    let mix = |c: usize| f64::from(scale[i][c]) * (1.0 - part) + f64::from(scale[i + 1][c]) * part;
    std::array::from_fn(|c| mix(c).round() as u8)
}

fn gradient(scale: &[[u8; 3]]) -> String {
    let stops: Vec<String> = scale.iter().map(|[r, g, b]| format!("rgb({r},{g},{b})")).collect();
    format!("linear-gradient(90deg,{})", stops.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_blue_under_the_target_white_at_it_red_far_above() {
        assert_eq!(error_colour(1.0), [247; 3]);
        assert_eq!([error_colour(0.0), error_colour(0.25)], [ERROR_COLOURS[0]; 2]);
        assert_eq!([error_colour(4.0), error_colour(f64::INFINITY)], [ERROR_COLOURS[4]; 2]);
        assert_eq!(error_colour(f64::NAN), EMPTY);
    }

    #[test]
    fn a_pixel_sums_what_is_in_its_square() {
        let n = 1024 * 3;
        let mut page = LightmapPage {
            width: 1024,
            height: 3,
            irradiance: vec![[100.0; 3]; n],
            half_difference: vec![[2.0, -2.0, 2.0]; n],
            coverage: vec![1.0; n],
            area: vec![0.25; n],
            ..LightmapPage::default()
        };
        // The second row is empty, the last alone in its square.
        page.area[1024..2048].fill(0.0);
        let grid = Grid::new(&page);
        assert_eq!((grid.width, grid.height, grid.step), (512, 2, 2));
        for p in grid.pixels(&page, 1.0) {
            assert_eq!(p.area, 0.5);
            assert!((p.error() - 0.02).abs() < 1e-6);
            assert_eq!(p.density(), 2.0);
        }
        assert!(grid.pixels(&page, 200.0).iter().all(|p| (p.error() - 0.01).abs() < 1e-6));
        page.area.fill(0.0);
        assert!(grid.pixels(&page, 1.0)[0].error().is_nan());
    }
}
