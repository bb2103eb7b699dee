//! 4. Direct light: what reaches a point straight from an emitter.
//!
//! In: a [`World`](crate::scene::World) and its [`Accel`](crate::accel::Accel). Out: for every texel the
//! irradiance E (lux) of direct light in two independent halves, and the points that photons start from.
//! Punctual lights, emissive triangles, suns and the sky are sampled at points spread over the texel's
//! surface; shadow rays pass MASK, BLEND and transmissive surfaces with their exact transmittance.

mod distribution;
mod emitters;
mod gather;
mod groups;
mod lighting;
mod open;
mod panel;
mod point;
mod polygon;
mod punctual;
mod receiver;
mod sky;
mod spherical;
mod strength;
mod tree;
mod visibility;

pub use emitters::{Emitters, LightSettings, PUNCTUAL_LOOP_LIMIT, SAMPLE_DIMENSIONS};
pub use gather::{Allocation, Direct, DirectPart, Growth, START_SLOTS};
pub use groups::LightGroup;
pub use lighting::Lighting;
pub use open::{COVER, cover_above, cover_height, cover_in_part, inside_solid, open_shares, shown_texels};
pub use point::{Leaving, LitPoint, StartSlot, TexelLight};
pub use receiver::Receiver;
pub use sky::SkySampler;
pub use strength::{MOST_IRRADIANCE, MOST_RADIANCE};
pub use visibility::Visibility;
