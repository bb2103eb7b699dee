//! stub
use crate::lightmap::LightmapPage;
/// stub
pub fn fill_gutters(_page: &mut LightmapPage, _gutter: u32) {}
