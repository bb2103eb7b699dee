//! Which instances get a lightmap.

use crate::error::BakeError;
use crate::options::BakeOptions;
use crate::scene::Scene;

/// For each instance whether it is baked: its node allows it, `--only` names it or is empty, `--exclude` does
/// not name it, and it has a triangle whose material receives light.
///
/// # Errors
/// [`BakeError::Options`] for a name that no node has, [`BakeError::Nothing`] where nothing is left.
pub(super) fn baked_instances(scene: &Scene, options: &BakeOptions) -> Result<Vec<bool>, BakeError> {
    for (flag, names) in [("--only", &options.only), ("--exclude", &options.exclude)] {
        for name in names {
            if !scene.instances.iter().any(|i| i.name == *name) {
                return Err(BakeError::Options(unknown_name(scene, flag, name)));
            }
        }
    }
    let baked: Vec<bool> = scene
        .instances
        .iter()
        .map(|i| {
            let chosen = options.only.is_empty() || options.only.contains(&i.name);
            let mesh = &scene.meshes[i.mesh];
            let receives = |p: &crate::scene::Primitive| !p.triangles.is_empty() && !scene.materials[p.material].unlit;
            i.bake && chosen && !options.exclude.contains(&i.name) && mesh.primitives.iter().any(receives)
        })
        .collect();
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
    Ok(baked)
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
