//! Which instances get a lightmap.

use crate::error::BakeError;
use crate::options::{BakeOptions, UvSource};
use crate::scene::{Instance, Material, Scene, fits};

/// The instances that get a lightmap.
#[derive(Debug, Clone)]
pub(super) struct Selected {
    /// For each instance whether it is baked.
    pub baked: Vec<bool>,
    /// Those that could be, but show no diffuse light.
    pub unseen: Vec<usize>,
}

/// An instance is baked if its node allows it, `--only` names it or is empty, `--exclude` does not name it, and it has
/// a triangle whose material receives light. With UVs of our own and without `--only`, it must show diffuse light as well:
/// on metal, glass and black surfaces nobody would see a map.
///
/// # Errors
/// [`BakeError::Options`] for a name that no node has, [`BakeError::Nothing`] where nothing is left.
pub(super) fn select(scene: &Scene, options: &BakeOptions) -> Result<Selected, BakeError> {
    for (flag, names) in [("--only", &options.only), ("--exclude", &options.exclude)] {
        for name in names {
            if !scene.instances.iter().any(|i| fits(name, &i.name)) {
                return Err(BakeError::Options(unknown_name(scene, flag, name)));
            }
        }
    }
    let receives = |i: &Instance| {
        let named = |names: &[String]| names.iter().any(|name| fits(name, &i.name));
        let chosen = options.only.is_empty() || named(&options.only);
        i.bake && chosen && !named(&options.exclude) && has_material(scene, i, &|m| !m.unlit)
    };
    let mut baked: Vec<bool> = scene.instances.iter().map(receives).collect();
    let shows = |i: &Instance| has_material(scene, i, &Material::shows_diffuse_light);
    let mut unseen: Vec<usize> = (0..baked.len()).filter(|&i| baked[i] && !shows(&scene.instances[i])).collect();
    // Where nothing else is left, that is what was asked for.
    let all = unseen.len() == baked.iter().filter(|b| **b).count();
    if options.uv == UvSource::Keep || !options.only.is_empty() || all {
        unseen.clear();
    }
    unseen.iter().for_each(|&i| baked[i] = false);
    if scene.instances.is_empty() {
        return Err(BakeError::Nothing(format!(
            "{}: has no nodes with triangle meshes, which are all that lightmaps are baked for",
            scene.name
        )));
    }
    if !baked.contains(&true) {
        return Err(BakeError::Nothing(format!(
            "{}: none of its {} nodes with meshes is left to bake; look at --only, --exclude, `bake` in the nodes' \
             extras, and unlit materials, which get no lightmap",
            scene.name,
            scene.instances.len()
        )));
    }
    Ok(Selected { baked, unseen })
}

/// Whether an instance has a triangle of a material that is `wanted`.
fn has_material(scene: &Scene, instance: &Instance, wanted: &dyn Fn(&Material) -> bool) -> bool {
    let mesh = &scene.meshes[instance.mesh];
    mesh.primitives.iter().any(|p| !p.triangles.is_empty() && wanted(&scene.materials[p.material]))
}

fn unknown_name(scene: &Scene, flag: &str, name: &str) -> String {
    let mut near: Vec<(usize, &str)> =
        scene.instances.iter().map(|i| (edit_distance(&i.name, name), i.name.as_str())).collect();
    near.sort_unstable();
    near.dedup();
    let near: Vec<String> = near.iter().take(3).map(|(_, n)| format!("`{n}`")).collect();
    if near.is_empty() {
        return format!("{flag} {name}: the scene has no nodes with meshes");
    }
    format!("{flag} {name}: no node with a mesh has this name; the nearest are {}", near.join(", "))
}

/// Levenshtein distance without regard to case.
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.to_lowercase().chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.to_lowercase().chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::edit_distance;

    #[test]
    fn distances() {
        assert_eq!(edit_distance("Floor", "floor"), 0);
        assert_eq!(edit_distance("kitten", "sitting"), 3);
        assert_eq!(edit_distance("", "abc"), 3);
    }
}
