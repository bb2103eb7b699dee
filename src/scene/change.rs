//! Changes to what a file says, by name: lights switched off, dimmed or given a profile, nodes weighed otherwise.

use super::{BakeMode, IesProfile, Light, LightKind, Scene};
use crate::error::BakeError;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;

/// What to change. Names may end in `*`, which stands for any end; where several fit, what is said last holds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Changes {
    /// By name of a light, of its node, or of a material that emits.
    pub lights: Vec<(String, LightChange)>,
    /// By name of a node that draws a mesh.
    pub nodes: Vec<(String, NodeChange)>,
}

/// What to change of a light; `None` leaves it as it is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LightChange {
    /// Which part of it is baked.
    pub bake: Option<BakeMode>,
    /// Factor on its light, from 0.
    pub scale: Option<f32>,
    /// IES file that a point or spot light shines as: with the intensity of the file, and the hue of the light.
    pub ies: Option<PathBuf>,
}

/// What to change of a node; `None` leaves it as it is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeChange {
    /// As extras `evenlight.weight`, from 0.
    pub weight: Option<f32>,
    /// As extras `evenlight.density`, above 0.
    pub density: Option<f32>,
    /// As extras `evenlight.bake`: whether it gets a lightmap.
    pub bake: Option<bool>,
    /// As extras `evenlight.casts`: whether it blocks and reflects light.
    pub casts: Option<bool>,
}

impl LightChange {
    /// This, and over it what `later` says.
    fn overlaid(self, later: &LightChange) -> LightChange {
        LightChange {
            bake: later.bake.or(self.bake),
            scale: later.scale.or(self.scale),
            ies: later.ies.clone().or(self.ies),
        }
    }
}

impl NodeChange {
    fn overlaid(self, later: &NodeChange) -> NodeChange {
        NodeChange {
            weight: later.weight.or(self.weight),
            density: later.density.or(self.density),
            bake: later.bake.or(self.bake),
            casts: later.casts.or(self.casts),
        }
    }
}

impl Scene {
    /// Applies `changes`; what was changed is added to [`changed`](Scene::changed).
    ///
    /// # Errors
    /// [`BakeError::Options`] for a name that nothing has, with the names that there are, and for a value out of range;
    /// [`BakeError::Scene`] for an IES file that cannot be read.
    pub fn change(&mut self, changes: &Changes) -> Result<(), BakeError> {
        check(changes)?;
        let fit = self.find_lights(&changes.lights)?;
        for (i, change) in fit.lights.into_iter().enumerate() {
            self.change_light(i, &change)?;
        }
        for (i, change) in fit.materials.into_iter().enumerate() {
            self.change_material(i, &change);
        }
        self.change_nodes(&changes.nodes)
    }

    /// What falls to each light and each material.
    fn find_lights(&self, changes: &[(String, LightChange)]) -> Result<Found, BakeError> {
        let mut found = Found {
            lights: vec![LightChange::default(); self.lights.len()],
            materials: vec![LightChange::default(); self.materials.len()],
        };
        let lamps = self.emissive_materials();
        for (name, change) in changes {
            let (mut any, mut profiled) = (false, change.ies.is_none());
            for (i, light) in self.lights.iter().enumerate() {
                if fits(name, &light.name) || self.node_name(light).is_some_and(|node| fits(name, node)) {
                    any = true;
                    let mut change = change.clone();
                    match light.kind {
                        LightKind::Directional { .. } | LightKind::Area(_) => change.ies = None,
                        _ => profiled = true,
                    }
                    found.lights[i] = std::mem::take(&mut found.lights[i]).overlaid(&change);
                }
            }
            for &i in lamps.iter().filter(|&&i| fits(name, &self.materials[i].name)) {
                any = true;
                let change = LightChange { ies: None, ..change.clone() };
                found.materials[i] = std::mem::take(&mut found.materials[i]).overlaid(&change);
            }
            if !any {
                let what = format!("no light, node with a light or material that emits is called `{name}`");
                return Err(BakeError::Options(format!("{what}; {}", self.light_names())));
            }
            if !profiled {
                let what = "is no point or spot light, and only those take an IES profile";
                return Err(BakeError::Options(format!("`{name}` {what}; {}", self.light_names())));
            }
        }
        Ok(found)
    }

    fn change_light(&mut self, i: usize, change: &LightChange) -> Result<(), BakeError> {
        let light = &mut self.lights[i];
        let mut said = Vec::new();
        if let Some(bake) = change.bake.filter(|&bake| bake != light.bake) {
            said.push(format!("baked {}, not {}", bake.word(), light.bake.word()));
            light.bake = bake;
        }
        if let Some(path) = &change.ies {
            let (profile, warnings) = IesProfile::from_file(path)?;
            said.push(format!("shines as {}, {:.0} lm", path.display(), profile.flux()));
            self.warnings.extend(warnings);
            light.set_profile(Arc::new(profile), hue(light.intensity));
        }
        if let Some(scale) = change.scale.filter(|&scale| scale != 1.0) {
            said.push(format!("times {scale}"));
            light.intensity = (light.intensity * scale).min(Vec3::MAX);
        }
        if !said.is_empty() {
            self.changed.push(format!("light {}: {}", light.name, said.join(", ")));
        }
        Ok(())
    }

    fn change_material(&mut self, i: usize, change: &LightChange) {
        let material = &mut self.materials[i];
        let mut said = Vec::new();
        if let Some(bake) = change.bake.filter(|&bake| bake != material.bake) {
            said.push(format!("baked {}, not {}", bake.word(), material.bake.word()));
            material.bake = bake;
        }
        if let Some(scale) = change.scale.filter(|&scale| scale != 1.0) {
            said.push(format!("times {scale}"));
            material.emission = (material.emission * scale).min(Vec3::MAX);
        }
        if !said.is_empty() {
            self.changed.push(format!("material {}: {}", material.name, said.join(", ")));
        }
    }

    fn change_nodes(&mut self, changes: &[(String, NodeChange)]) -> Result<(), BakeError> {
        let mut found = vec![NodeChange::default(); self.instances.len()];
        for (name, change) in changes {
            let mut any = false;
            for (i, _) in self.instances.iter().enumerate().filter(|(_, instance)| fits(name, &instance.name)) {
                any = true;
                found[i] = found[i].overlaid(change);
            }
            if !any {
                let names = listed(self.instances.iter().map(|i| i.name.as_str()));
                return Err(BakeError::Options(format!("no node with a mesh is called `{name}`; there are {names}")));
            }
        }
        for (instance, change) in self.instances.iter_mut().zip(found) {
            let mut said = Vec::new();
            let mut set = |key: &str, was: &mut f32, new: Option<f32>| {
                if let Some(new) = new.filter(|new| new != was) {
                    said.push(format!("{key} {new}, not {was}"));
                    *was = new;
                }
            };
            set("weight", &mut instance.weight, change.weight);
            set("density", &mut instance.density, change.density);
            let mut switch = |key: &str, was: &mut bool, new: Option<bool>| {
                if let Some(new) = new.filter(|new| new != was) {
                    said.push(format!("{key} {new}"));
                    *was = new;
                }
            };
            switch("bake", &mut instance.bake, change.bake);
            switch("casts", &mut instance.casts, change.casts);
            if !said.is_empty() {
                self.changed.push(format!("node {}: {}", instance.name, said.join(", ")));
            }
        }
        Ok(())
    }

    /// Materials that emit and are used.
    pub(crate) fn emissive_materials(&self) -> BTreeSet<usize> {
        let used = self.meshes.iter().flat_map(|m| &m.primitives).map(|p| p.material);
        let emits = |&i: &usize| self.materials.get(i).is_some_and(|m| m.emission.max_element() > 0.0 && !m.unlit);
        used.filter(emits).collect()
    }

    /// Name of the node of a light.
    pub(crate) fn node_name(&self, light: &Light) -> Option<&str> {
        self.source.json.get("nodes")?.get(light.node?)?.get("name")?.as_str()
    }

    fn light_names(&self) -> String {
        let lights = self.lights.iter().flat_map(|l| [Some(l.name.as_str()), self.node_name(l)]).flatten();
        let lamps = self.emissive_materials();
        let materials = lamps.iter().map(|&i| self.materials[i].name.as_str());
        match (self.lights.is_empty(), lamps.is_empty()) {
            (true, true) => "the scene has none".into(),
            (true, false) => format!("there are the materials {}", listed(materials)),
            (false, true) => format!("there are the lights {}", listed(lights)),
            (false, false) => {
                format!("there are the lights {} and the materials {}", listed(lights), listed(materials))
            }
        }
    }
}

/// What falls to each light and each material of a scene.
struct Found {
    lights: Vec<LightChange>,
    materials: Vec<LightChange>,
}

fn check(changes: &Changes) -> Result<(), BakeError> {
    let fail = |what: String| Err(BakeError::Options(what));
    for (name, change) in &changes.lights {
        if let Some(scale) = change.scale.filter(|s| !(*s >= 0.0 && s.is_finite())) {
            return fail(format!("light `{name}`: the scale {scale} must be a number from 0"));
        }
    }
    for (name, change) in &changes.nodes {
        if let Some(weight) = change.weight.filter(|w| !(*w >= 0.0 && w.is_finite())) {
            return fail(format!("node `{name}`: the weight {weight} must be a number from 0"));
        }
        if let Some(density) = change.density.filter(|d| !(*d >= 1e-3 && d.is_finite())) {
            return fail(format!("node `{name}`: the density {density} must be a number from 0.001"));
        }
    }
    Ok(())
}

/// Whether `pattern`, which may end in `*`, stands for `name`.
pub(crate) fn fits(pattern: &str, name: &str) -> bool {
    pattern == name || pattern.strip_suffix('*').is_some_and(|start| name.starts_with(start))
}

/// `color` at a luminance of 1, so that a luxmeter reads what the profile says; white where there is none.
fn hue(color: Vec3) -> Vec3 {
    let luminance = color.dot(Vec3::new(0.2126, 0.7152, 0.0722));
    if luminance > 0.0 { color / luminance } else { Vec3::ONE }
}

/// Names in quotes, each once; of many the first.
pub(crate) fn listed<'n>(names: impl Iterator<Item = &'n str>) -> String {
    const MOST: usize = 30;
    let names: BTreeSet<&str> = names.collect();
    let shown: Vec<String> = names.iter().take(MOST).map(|n| format!("`{n}`")).collect();
    let more = names.len().saturating_sub(MOST);
    shown.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() }
}
