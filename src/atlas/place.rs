//! Charts on pages, no more of them than fit: on one page where the density is not given, and into the memory.

use super::layout::Unwrapping;
use super::{Atlas, memory_bytes};
use crate::error::{BakeError, Warning};
use crate::options::{BakeOptions, Density};
use crate::scene::World;

/// Times that a density is lowered for want of memory.
const MEMORY_TRIES: u32 = 4;

/// Part of the memory limit that a lower density is to take, which is rounded to whole texels.
const MEMORY_MARGIN: f64 = 0.97;

impl Unwrapping<'_> {
    /// An atlas of `density`, which was found for `options` or is theirs. One that was found gives way to the highest that
    /// fits on one page, and one that is not given as a number to the highest that a bake of `world` has memory for.
    ///
    /// # Errors
    /// [`BakeError::Limit`] where the pages do not suffice, and [`BakeError::Cancelled`].
    pub fn place(
        &self,
        world: &World,
        density: Density,
        options: &BakeOptions,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Atlas, BakeError> {
        let with = |density: Density| self.lay_out(&BakeOptions { density, ..options.clone() }, cancelled);
        if let Density::TexelsPerMetre(_) = options.density {
            return with(density);
        }
        let found = with(density);
        let atlas = match density {
            Density::TexelsPerMetre(_) if !found.as_ref().is_ok_and(|a| a.pages.len() == 1) => with(Density::Even)?,
            _ => found?,
        };
        within_memory(atlas, world, options, &with)
    }
}

/// `atlas`, or one `with` a density so low that a bake has memory enough.
fn within_memory(
    mut atlas: Atlas,
    world: &World,
    options: &BakeOptions,
    with: &dyn Fn(Density) -> Result<Atlas, BakeError>,
) -> Result<Atlas, BakeError> {
    let (full, limit) = (atlas.texels_per_metre, options.memory_limit);
    // Memory is a part that remains, and one in proportion to the square of the density: none known yet.
    let (mut remains, mut last) = (0.0, None);
    let most = MEMORY_MARGIN * limit as f64;
    for _ in 0..MEMORY_TRIES {
        let (asked, square) = (memory_bytes(world, &atlas, options), atlas.texels_per_metre.powi(2));
        if asked <= limit {
            break;
        }
        let asked = asked as f64;
        if let Some((more, larger)) = last.replace((asked, square))
            && larger > square
        {
            remains = (asked - square * (more - asked) / (larger - square)).clamp(0.0, asked);
        }
        if remains >= most {
            break;
        }
        atlas = with(Density::TexelsPerMetre((square * (most - remains) / (asked - remains)).sqrt()))?;
    }
    if atlas.texels_per_metre < full {
        let share = 100.0 * (atlas.texels_per_metre / full).powi(2);
        let message = format!(
            "texels: {share:.0} % of those that would do, for a bake with more takes over {} MiB; raise --memory-limit or \
             lower --max-texture",
            limit >> 20
        );
        atlas.warnings.push(Warning::new("density-limited-by-memory", message));
    }
    Ok(atlas)
}
