//! Groups of lights whose light is kept apart, so that each can be dimmed or coloured later without a bake.

use crate::error::BakeError;
use crate::scene::{BakeMode, Light, Scene, fits, listed};

/// The group of all lights that no group is named for.
const REST: &str = "rest";

/// What the light from beyond the geometry is called.
const SKY: &str = "sky";

/// Most groups: each is solved by itself.
const MOST_GROUPS: usize = 16;

/// Longest name (bytes): with `.R` it is one of OpenEXR's short names.
const LONGEST_NAME: usize = 29;

/// Lights that are solved together. Every light is in one group.
#[derive(Debug, Clone, PartialEq)]
pub struct LightGroup {
    /// Its name, which is that of its layer in the maps.
    pub name: String,
    /// Names of its lights, of materials that emit, and `sky`.
    pub members: Vec<String>,
    /// By index into the lights of the bake.
    pub(super) lights: Vec<bool>,
    /// By index into the materials of the scene.
    pub(super) materials: Vec<bool>,
    pub(super) sky: bool,
}

impl LightGroup {
    /// The groups that `rules`, pairs of a group's name and a pattern of names, make of `lights`, of the materials of
    /// `scene` that emit, and of the sky, where there is one: in the order in which they are named, with what is in none
    /// last, as `rest`. Of several rules for one light the last holds. Without rules there are no groups.
    pub(super) fn all(
        scene: &Scene,
        lights: &[Light],
        has_sky: bool,
        rules: &[(String, String)],
    ) -> Result<Vec<LightGroup>, BakeError> {
        let Some((last, _)) = rules.last() else { return Ok(Vec::new()) };
        let mut names: Vec<&str> = Vec::new();
        for (group, _) in rules {
            check_name(group)?;
            if !names.contains(&group.as_str()) {
                names.push(group);
            }
        }
        names.push(REST);
        if names.len() > MOST_GROUPS {
            return Err(BakeError::Options(format!(
                "--group {last}: there are more than {MOST_GROUPS} groups, with `{REST}`; put lights together"
            )));
        }
        let lamps = scene.emissive_materials();
        let lit: Vec<Source> = lights
            .iter()
            .enumerate()
            .filter(|(_, l)| l.bake != BakeMode::Off)
            .map(|(i, l)| Source { name: &l.name, node: scene.node_name(l), what: What::Light(i) })
            .chain(lamps.iter().filter(|&&i| scene.materials[i].bake != BakeMode::Off).map(|&i| Source {
                name: &scene.materials[i].name,
                node: None,
                what: What::Material(i),
            }))
            .chain(has_sky.then_some(Source { name: SKY, node: None, what: What::Sky }))
            .collect();
        for (group, pattern) in rules {
            if !lit.iter().any(|source| source.fits(pattern)) {
                let names = listed(lit.iter().flat_map(|source| [Some(source.name), source.node]).flatten());
                let there = if lit.is_empty() { "there is none".into() } else { format!("there are {names}") };
                return Err(BakeError::Options(format!(
                    "--group {group}={pattern}: no light that is baked is called `{pattern}`; {there}"
                )));
            }
        }
        let mut groups: Vec<LightGroup> = names
            .iter()
            .map(|name| LightGroup {
                name: (*name).into(),
                members: Vec::new(),
                lights: vec![false; lights.len()],
                materials: vec![false; scene.materials.len()],
                sky: false,
            })
            .collect();
        for source in &lit {
            let rule = rules.iter().rev().find(|(_, pattern)| source.fits(pattern));
            let name = rule.map_or(REST, |(group, _)| group);
            let Some(group) = groups.iter_mut().find(|g| g.name == name) else { continue };
            group.members.push(source.name.into());
            match source.what {
                What::Light(i) => group.lights[i] = true,
                What::Material(i) => group.materials[i] = true,
                What::Sky => group.sky = true,
            }
        }
        groups.retain(|g| !g.members.is_empty());
        Ok(groups)
    }
}

/// Something that shines.
struct Source<'a> {
    name: &'a str,
    node: Option<&'a str>,
    what: What,
}

enum What {
    Light(usize),
    Material(usize),
    Sky,
}

impl Source<'_> {
    fn fits(&self, pattern: &str) -> bool {
        fits(pattern, self.name) || self.node.is_some_and(|node| fits(pattern, node))
    }
}

/// Names become layers of EXR files, `name.R`.
fn check_name(name: &str) -> Result<(), BakeError> {
    let plain = |b: u8| b.is_ascii_alphanumeric() || b == b'_' || b == b'-';
    if name.is_empty() || name.len() > LONGEST_NAME || !name.bytes().all(plain) {
        let takes = "is made of letters, digits, `-` and `_`";
        return Err(BakeError::Options(format!("--group {name}: the name of a group {takes}, {LONGEST_NAME} at most")));
    }
    if RESERVED.contains(&name) {
        return Err(BakeError::Options(format!("--group {name}: another layer has this name; choose another")));
    }
    Ok(())
}

/// Names of other layers, and of what no group is named for.
const RESERVED: [&str; 5] = ["half_difference", "coverage", "area", "back", REST];

#[cfg(test)]
mod tests {
    use super::check_name;

    #[test]
    fn names_are_those_of_layers() {
        for name in ["lamps", "Sun-1", "key_light"] {
            assert!(check_name(name).is_ok(), "{name}");
        }
        for name in ["", "a.b", "a b", "back", "rest", "caf\u{e9}", &"x".repeat(30)] {
            assert!(check_name(name).unwrap_err().to_string().contains("--group"), "{name}");
        }
    }
}
