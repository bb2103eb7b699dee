//! Where on its page a node's lightmap lies, said once for the GLB, the manifest and every engine.

use crate::atlas::Atlas;
use crate::scene::Scene;
use glam::Vec2;

/// A node's place in the lightmaps. Rectangles are x, y, width, height in [0, 1] of the page, from its top
/// left corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NodeRect {
    /// Page index.
    pub page: u32,
    /// Page UV = rect.xy + TEXCOORD_1 * rect.wh with the TEXCOORD_1 of the written scene: the whole page
    /// where TEXCOORD_1 already speaks of the page.
    pub rect: [f32; 4],
    /// The part of the page that the node occupies.
    pub occupied: [f32; 4],
}

/// Place of each scene instance; `None` where it is not baked or its page is not in the atlas.
///
/// A mesh that is baked once gets the UVs of the page itself, so that engines without rectangles need none;
/// a mesh that several nodes share keeps UVs of its own, and each node a rectangle.
pub fn node_rects(scene: &Scene, atlas: &Atlas) -> Vec<Option<NodeRect>> {
    let baked = baked_instances(scene, atlas);
    (0..scene.instances.len())
        .map(|i| {
            let (page, occupied) = occupied(atlas, i)?;
            let once = baked[scene.instances[i].mesh].len() == 1;
            Some(NodeRect { page, rect: if once { [0.0, 0.0, 1.0, 1.0] } else { occupied }, occupied })
        })
        .collect()
}

/// For each scene mesh the instances that have a place in the atlas.
pub(super) fn baked_instances(scene: &Scene, atlas: &Atlas) -> Vec<Vec<usize>> {
    let mut instances = vec![Vec::new(); scene.meshes.len()];
    for (i, instance) in scene.instances.iter().enumerate() {
        if occupied(atlas, i).is_some() {
            instances[instance.mesh].push(i);
        }
    }
    instances
}

/// Page and rectangle of an instance.
fn occupied(atlas: &Atlas, instance: usize) -> Option<(u32, [f32; 4])> {
    let placement = atlas.placements.get(instance).copied().flatten()?;
    let page = atlas.pages.get(placement.page as usize)?;
    let size = Vec2::new(page.width as f32, page.height as f32);
    let (origin, extent) = (placement.origin / size, placement.size / size);
    Some((placement.page, [origin.x, origin.y, extent.x, extent.y]))
}
