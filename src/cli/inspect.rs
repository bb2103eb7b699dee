//! `evenlight inspect`: what is in a scene, what will be baked, what is wrong with it.

use evenlight::Warning;
use evenlight::accel::{coincident_warning, part_coincident};
use evenlight::scene::{AreaShape, IesProfile, Light, LightKind, Scene, Sky, SurfaceFlags, World};
use serde::Serialize;
use std::fmt::{self, Write};

/// Triangles among which surfaces in one plane are looked for, at most: of 7.7 million it takes more than 2 GB.
const MOST_COMPARED: usize = 2_000_000;

/// What a scene holds. Lengths in metres, areas in square metres, colours linear Rec. 709.
#[derive(Debug, Serialize)]
pub struct Inspection {
    /// File stem of the scene.
    pub name: String,
    /// Corners of the box around everything [m]; `None` without geometry.
    pub bounds: Option<[[f64; 3]; 2]>,
    /// Triangles over all instances.
    pub triangles: usize,
    /// Of these, triangles without area, which neither block nor receive light.
    pub degenerate_triangles: usize,
    /// Meshes drawn at least once.
    pub meshes: usize,
    /// Area of all instances, one side [m^2].
    pub area: f64,
    /// Area of the instances that get a lightmap, one side [m^2].
    pub baked_area: f64,
    /// One entry per node that draws a mesh.
    pub instances: Vec<InstanceEntry>,
    /// Lights of the file.
    pub lights: Vec<LightEntry>,
    /// Materials that emit, with the area they cover.
    pub emitters: Vec<EmitterEntry>,
    /// Light from beyond the geometry.
    pub sky: Option<String>,
    /// Names of the cameras.
    pub cameras: Vec<String>,
    /// Variants of the materials that a bake can choose from.
    pub variants: Vec<String>,
    /// Images that materials use.
    pub textures: Vec<TextureEntry>,
    /// What the loader found odd, and what a bake of this scene would trip over.
    pub warnings: Vec<Warning>,
}

/// A node that draws a mesh.
#[derive(Debug, Serialize)]
pub struct InstanceEntry {
    /// Name of the node.
    pub name: String,
    /// Name of its mesh.
    pub mesh: String,
    /// Its triangles.
    pub triangles: usize,
    /// Its area, one side [m^2].
    pub area: f64,
    /// Gets a lightmap.
    pub bake: bool,
    /// Blocks and reflects light.
    pub casts: bool,
    /// Weight in the error figures.
    pub weight: f32,
    /// Factor on the texel density.
    pub density: f32,
    /// All of its primitives have normals; others are shaded flat.
    pub normals: bool,
    /// All of its primitives have a second set of texture coordinates, which could be kept as lightmap UVs.
    pub second_uv: bool,
    /// Its transform mirrors.
    pub mirrored: bool,
}

/// A light of the file.
#[derive(Debug, Serialize)]
pub struct LightEntry {
    /// Name of the light.
    pub name: String,
    /// `point`, `spot`, `directional`, `rectangle` or `disc`.
    pub kind: &'static str,
    /// Candela, along the brightest direction of a profile; lux for a directional light; nit for one with an area.
    pub intensity: [f32; 3],
    /// Its IES profile.
    pub profile: Option<ProfileEntry>,
    /// `full`, `indirect` or `off`.
    pub bake: &'static str,
}

/// The IES profile of a light.
#[derive(Debug, Serialize)]
pub struct ProfileEntry {
    /// Name of the file.
    pub file: String,
    /// Flux of the light [lm], of its brightest channel.
    pub lumens: f64,
    /// Rated flux of its lamps [lm]; none where photometry is absolute.
    pub lamp_lumens: Option<f64>,
}

/// A material that emits.
#[derive(Debug, Serialize)]
pub struct EmitterEntry {
    /// Name of the material.
    pub material: String,
    /// Emitted radiance [nit], before its texture.
    pub radiance: [f32; 3],
    /// Area it covers, one side [m^2].
    pub area: f64,
}

/// An image that materials use.
#[derive(Debug, Serialize)]
pub struct TextureEntry {
    /// Name of the image.
    pub name: String,
    /// Size of its file [bytes].
    pub bytes: usize,
    /// Why it cannot be decoded and is taken as white.
    pub error: Option<String>,
}

/// Looks at everything in a scene; decodes its images.
pub fn inspect(scene: &Scene) -> Inspection {
    let mut world = World::new(scene);
    let square_metres = world.frame.metres * world.frame.metres;
    let mut instances = Vec::with_capacity(scene.instances.len());
    let mut material_areas = vec![0.0; scene.materials.len()];
    let (mut lo, mut hi) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for (i, instance) in scene.instances.iter().enumerate() {
        let mesh = &scene.meshes[instance.mesh];
        let mut area = 0.0;
        for t in world.first_triangle[i]..world.first_triangle[i + 1] {
            let a = world.area(t) * square_metres;
            area += a;
            material_areas[world.primitive(t).0.material] += a;
            for corner in world.positions[t as usize] {
                let p = world.frame.to_world(corner).to_array();
                lo = std::array::from_fn(|k| lo[k].min(p[k]));
                hi = std::array::from_fn(|k| hi[k].max(p[k]));
            }
        }
        instances.push(InstanceEntry {
            name: instance.name.clone(),
            mesh: mesh.name.clone(),
            triangles: mesh.triangle_count(),
            area,
            bake: instance.bake,
            casts: instance.casts,
            weight: instance.weight,
            density: instance.density,
            normals: mesh.primitives.iter().all(|p| !p.normals.is_empty()),
            second_uv: mesh.primitives.iter().all(|p| p.tex_coords.get(1).is_some_and(|s| !s.is_empty())),
            mirrored: instance.world_from_object.matrix3.determinant() < 0.0,
        });
    }
    let mut inspection = Inspection {
        name: scene.name.clone(),
        bounds: (lo[0] <= hi[0]).then_some([lo, hi]),
        triangles: world.len(),
        degenerate_triangles: world.flags.iter().filter(|f| f.has(SurfaceFlags::DEGENERATE)).count(),
        meshes: scene.meshes.len(),
        area: instances.iter().map(|i| i.area).sum(),
        baked_area: instances.iter().filter(|i| i.bake).map(|i| i.area).sum(),
        instances,
        lights: scene.lights.iter().map(light_entry).collect(),
        emitters: emitters(scene, &material_areas),
        sky: scene.sky.as_ref().map(describe_sky),
        cameras: scene.cameras.iter().map(|c| c.name.clone()).collect(),
        variants: scene.source.variants(),
        textures: scene
            .textures
            .iter()
            .map(|t| TextureEntry { name: t.name.clone(), bytes: t.encoded.len(), error: t.decode_error() })
            .collect(),
        warnings: scene.warnings.clone(),
    };
    let found = judge(&inspection, scene, &material_areas);
    inspection.warnings.extend(found);
    if world.len() > MOST_COMPARED {
        let what = format!(
            "of {} triangles, those that lie in the plane of others are looked for by a bake alone: it takes memory",
            world.len()
        );
        inspection.warnings.push(Warning::new("coincident-not-looked-for", what));
    } else {
        // Last, for it moves what was measured.
        let parted = part_coincident(&mut world);
        inspection.warnings.extend(coincident_warning(&world, &parted));
    }
    inspection
}

fn light_entry(light: &Light) -> LightEntry {
    let kind = match light.kind {
        LightKind::Point => "point",
        LightKind::Spot { .. } => "spot",
        LightKind::Directional { .. } => "directional",
        LightKind::Area(AreaShape::Rectangle { .. }) => "rectangle",
        LightKind::Area(AreaShape::Disc { .. }) => "disc",
    };
    LightEntry {
        name: light.name.clone(),
        kind,
        intensity: light.intensity.to_array(),
        profile: light.profile.as_ref().map(|profile| profile_entry(light, profile)),
        bake: light.bake.word(),
    }
}

fn profile_entry(light: &Light, profile: &IesProfile) -> ProfileEntry {
    // The same of all channels: what of the profile's intensity its light has.
    let share = if profile.peak() > 0.0 { f64::from(light.intensity.max_element()) / profile.peak() } else { 0.0 };
    ProfileEntry { file: profile.name.clone(), lumens: profile.flux() * share, lamp_lumens: profile.lamp_lumens() }
}

fn emitters(scene: &Scene, areas: &[f64]) -> Vec<EmitterEntry> {
    let entries = scene
        .materials
        .iter()
        .zip(areas)
        .filter(|(m, area)| m.emission.max_element() > 0.0 && !m.unlit && **area > 0.0);
    entries.map(|(m, &area)| EmitterEntry { material: m.name.clone(), radiance: m.emission.to_array(), area }).collect()
}

fn describe_sky(sky: &Sky) -> String {
    match sky {
        Sky::Constant(c) => format!("constant {} {} {} nit", c.x, c.y, c.z),
        Sky::Image { width, height, .. } => format!("image of {width} x {height} texels"),
        Sky::Cube(map) => {
            let (n, mean) = (map.size(), map.mean());
            format!("cube of {n} x {n} texels a face, {} {} {} nit on average", mean.x, mean.y, mean.z)
        }
    }
}

/// What a bake of the scene would trip over.
fn judge(i: &Inspection, scene: &Scene, areas: &[f64]) -> Vec<Warning> {
    let mut found = Vec::new();
    let mut say = |code, message: String| found.push(Warning::new(code, message));
    if i.triangles == i.degenerate_triangles {
        say("nothing-to-bake", "no triangle has an area".into());
        return found;
    }
    if !i.instances.iter().any(|e| e.bake) {
        say("nothing-to-bake", "extras exclude every node from the bake".into());
    }
    if i.emitters.is_empty() && i.sky.is_none() && !i.lights.iter().any(|l| l.bake != "off") {
        say("no-light", "no light, emitter or sky: add one to the file, or give a sky or a sun to the bake".into());
    }
    for t in &i.textures {
        if let Some(e) = &t.error {
            say("image-not-decoded", format!("image '{}' cannot be decoded ({e}) and is taken as white", t.name));
        }
    }
    let size = i.bounds.map_or(0.0, |[lo, hi]| (0..3).map(|k| hi[k] - lo[k]).fold(0.0, f64::max));
    if !(0.1..=2000.0).contains(&size) {
        say("odd-scale", format!("the scene is {size:.3} m across; glTF is in metres"));
    }
    if let Some(e) = i.instances.iter().find(|e| e.bake && e.area > 0.9 * i.baked_area && i.instances.len() > 1) {
        let share = 100.0 * e.area / i.baked_area;
        say("one-large-node", format!("node '{}' has {share:.0} % of the area and will take the texels", e.name));
    }
    for (m, _) in scene.materials.iter().zip(areas).filter(|(_, area)| **area > 0.0) {
        let both_ways = m.base_color.truncate().lerp(m.diffuse_transmission_color, m.diffuse_transmission);
        let reflectance = both_ways.max_element() * (1.0 - m.metallic);
        let mut textures =
            [&m.base_color_texture, &m.diffuse_transmission_texture, &m.diffuse_transmission_color_texture].into_iter();
        if reflectance > 0.95 && textures.all(Option::is_none) && !m.unlit && m.transmission == 0.0 {
            say(
                "very-white",
                format!(
                    "material '{}' {} {:.0} % of the light; no real surface does",
                    m.name,
                    if m.diffuse_transmission > 0.0 { "reflects and transmits" } else { "reflects" },
                    100.0 * reflectance
                ),
            );
        }
    }
    found
}

/// Rows shown of each table.
const ROWS: usize = 20;

impl Inspection {
    /// The inspection for people.
    pub fn text(&self) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = self.write(&mut out);
        out
    }

    fn write(&self, out: &mut String) -> fmt::Result {
        writeln!(out, "{}", self.name)?;
        if let Some([lo, hi]) = self.bounds {
            let [x, y, z]: [f64; 3] = std::array::from_fn(|k| hi[k] - lo[k]);
            writeln!(out, "  size        {x:.2} x {y:.2} x {z:.2} m (width, height, depth)")?;
        }
        let degenerate = self.degenerate_triangles;
        let without_area = if degenerate > 0 { format!(", {degenerate} without area") } else { String::new() };
        writeln!(out, "  triangles   {}{without_area}", self.triangles)?;
        writeln!(out, "  nodes       {} drawing {} meshes", self.instances.len(), self.meshes)?;
        writeln!(out, "  area        {:.2} m2, {:.2} m2 of it baked", self.area, self.baked_area)?;
        let flat = self.instances.iter().filter(|i| !i.normals).count();
        if flat > 0 {
            writeln!(out, "  normals     none on {flat} nodes, which are shaded flat")?;
        }
        let second = self.instances.iter().filter(|i| i.second_uv).count();
        writeln!(out, "  second UVs  on {second} of {} nodes", self.instances.len())?;
        if let Some(sky) = &self.sky {
            writeln!(out, "  sky         {sky}")?;
        }
        if !self.cameras.is_empty() {
            writeln!(out, "  cameras     {}", self.cameras.join(", "))?;
        }
        if !self.variants.is_empty() {
            writeln!(out, "  variants    {}", self.variants.join(", "))?;
        }

        let lights = self.lights.iter().map(|l| {
            let unit = match l.kind {
                "directional" => "lux",
                "rectangle" | "disc" => "nit",
                _ => "cd",
            };
            let [r, g, b] = l.intensity;
            let profile = l.profile.as_ref();
            let profile = profile.map_or(String::new(), |p| format!(", {:.0} lm by {}", p.lumens, p.file));
            format!("{:<24} {:<12} {r} {g} {b} {unit}{profile}, baked: {}", l.name, l.kind, l.bake)
        });
        table(out, "lights", lights)?;
        let emitters = self.emitters.iter().map(|e| {
            let [r, g, b] = e.radiance;
            format!("{:<24} {r} {g} {b} nit on {:.3} m2", e.material, e.area)
        });
        table(out, "emitters", emitters)?;
        let textures = self.textures.iter().map(|t| {
            format!(
                "{:<24} {} kB{}",
                t.name,
                t.bytes.div_ceil(1024),
                if t.error.is_some() { ", not decoded" } else { "" }
            )
        });
        table(out, "images", textures)?;
        let mut largest: Vec<&InstanceEntry> = self.instances.iter().collect();
        largest.sort_by(|a, b| b.area.total_cmp(&a.area));
        let nodes = largest.iter().map(|i| {
            let mut notes = String::new();
            for (on, note) in [
                (!i.bake, ", not baked"),
                (!i.casts, ", casts nothing"),
                (i.mirrored, ", mirrored"),
                (!i.normals, ", flat"),
            ] {
                notes.push_str(if on { note } else { "" });
            }
            format!("{:<24} {:>10} triangles {:>12.3} m2{notes}", i.name, i.triangles, i.area)
        });
        table(out, "nodes by area", nodes)?;
        table(out, "warnings", self.warnings.iter().map(|w| format!("{}: {}", w.code, w.message)))
    }
}

fn table(out: &mut String, title: &str, rows: impl IntoIterator<Item = String>) -> fmt::Result {
    let rows: Vec<String> = rows.into_iter().collect();
    if rows.is_empty() {
        return Ok(());
    }
    writeln!(out, "\n{title}")?;
    for row in rows.iter().take(ROWS) {
        writeln!(out, "  {row}")?;
    }
    if rows.len() > ROWS {
        writeln!(out, "  and {} more", rows.len() - ROWS)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(json: &str) -> Scene {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("tiny.gltf");
        std::fs::write(&path, json).expect("the folder can be written");
        Scene::from_gltf(&path).expect("the scene is good")
    }

    #[test]
    fn an_empty_scene_says_so() {
        let i = inspect(&scene(r#"{"asset": {"version": "2.0"}, "scenes": [{}]}"#));
        assert_eq!(i.warnings[0].code, "nothing-to-bake");
        assert!(i.text().contains("triangles   0"));
    }

    #[test]
    fn a_triangle_is_measured() {
        // Corners (0, 0, 0), (2, 0, 0), (0, 3, 0) as 8-bit integers.
        let i = inspect(&scene(
            r#"{"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}],
                "nodes": [{"name": "leaf", "mesh": 0, "scale": [1, -1, 1]}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "accessors": [{"bufferView": 0, "componentType": 5121, "type": "VEC3", "count": 3}],
                "bufferViews": [{"buffer": 0, "byteLength": 9}],
                "buffers": [{"byteLength": 9, "uri": "data:;base64,AAAAAgAAAAMA"}]}"#,
        ));
        assert!((i.area - 3.0).abs() < 1e-6);
        assert_eq!(i.bounds, Some([[0.0, -3.0, 0.0], [2.0, 0.0, 0.0]]));
        assert!(i.instances[0].mirrored);
        assert!(i.warnings.iter().any(|w| w.code == "no-light"));
        assert!(i.text().contains("leaf"));
    }

    #[test]
    fn a_face_that_is_there_twice_is_named() {
        let i = inspect(&scene(
            r#"{"asset": {"version": "2.0"}, "scenes": [{"nodes": [0, 1]}],
                "nodes": [{"name": "leaf", "mesh": 0}, {"name": "copy", "mesh": 0}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "accessors": [{"bufferView": 0, "componentType": 5121, "type": "VEC3", "count": 3}],
                "bufferViews": [{"buffer": 0, "byteLength": 9}],
                "buffers": [{"byteLength": 9, "uri": "data:;base64,AAAAAgAAAAMA"}]}"#,
        ));
        let said = i.warnings.iter().find(|w| w.code == "coincident-surfaces").expect("a warning");
        assert!(said.message.contains("leaf (1)"), "{}", said.message);
    }
}
