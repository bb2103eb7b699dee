//! 6. The finished maps in memory.

mod gutter;

pub use gutter::fill_gutters;

/// The finished lightmaps, one per atlas page.
#[derive(Debug, Clone, Default)]
pub struct Lightmap {
    /// In the order of [`Atlas::pages`](crate::atlas::Atlas::pages).
    pub pages: Vec<LightmapPage>,
}

/// One page. All vectors are row-major, `width * height` long, row 0 at v = 0, texel centres at +0.5.
#[derive(Debug, Clone, Default)]
pub struct LightmapPage {
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
    /// Irradiance E [lux], linear Rec. 709 RGB, as stored: texels without coverage filled by
    /// [`fill_gutters`].
    pub irradiance: Vec<[f32; 3]>,
    /// Half the difference of the two halves, (E_odd - E_even) / 2 [lux]: as noisy as E itself.
    pub half_difference: Vec<[f32; 3]>,
    /// Irradiance of the back side where double-sided surfaces are stored as two layers; empty otherwise.
    pub back: Vec<[f32; 3]>,
    /// Share of the texel's square inside its chart, in [0, 1]; 0 in gutters.
    pub coverage: Vec<f32>,
    /// Surface area mapped to the texel [m2].
    pub area: Vec<f32>,
}
