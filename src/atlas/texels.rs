//! Which surface each texel covers.

/// Placeholder until the rasteriser lands.
#[derive(Debug, Clone, Default)]
pub struct Texels {}
/// Placeholder.
#[derive(Debug, Clone, Copy, Default)]
pub struct Texel {}
/// Placeholder.
#[derive(Debug, Clone, Copy, Default)]
pub struct Piece {}
