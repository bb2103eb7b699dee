//! Light at one point of a texel: what reaches it, and one of the ways in which that leaves.

use super::emitters::{Emitters, SAMPLE_DIMENSIONS};
use super::open::{cover_above, cover_in_part};
use super::receiver::Receiver;
use super::visibility::Visibility;
use crate::atlas::{TexelSampler, Texels};
use crate::sampling::Stream;
use crate::scene::SurfaceFlags;
use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// A point that photons start from, drawn among the texel's direct samples in proportion to the largest
/// channel of what leaves there: of B = rho E, on either side, or of what is thrown (weighted reservoir sampling: Chao 1982).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StartSlot {
    /// Triangle id.
    pub triangle: u32,
    /// Barycentric weights of the second and third corner.
    pub uv: Vec2,
    /// B over its largest channel, in units of 1 / 65535.
    pub color: [u16; 3],
    /// Largest channel of B as it was sampled (lux).
    pub largest: f32,
    /// How it leaves.
    way: PackedWay,
}

/// How light leaves a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Leaving {
    /// Diffusely, on the side that it came from.
    Reflected,
    /// Diffusely, on the far side.
    Transmitted,
    /// In this unit direction, as from a mirror or through a lens.
    Along(Vec3),
}

impl StartSlot {
    /// No point.
    pub(super) const NONE: StartSlot =
        StartSlot { triangle: u32::MAX, uv: Vec2::ZERO, color: [0; 3], largest: 0.0, way: PackedWay::REFLECTED };

    /// A point where light is reflected; `None` where none is.
    pub fn new(point: &LitPoint) -> Option<StartSlot> {
        let largest = point.leaving.max_element();
        let color = (point.leaving / largest * 65535.0).round();
        let color = [color.x as u16, color.y as u16, color.z as u16];
        let way = PackedWay::new(point.way);
        (largest > 0.0).then_some(StartSlot { triangle: point.at.triangle, uv: point.at.uv, color, largest, way })
    }

    /// B over its largest channel.
    pub fn color(&self) -> Vec3 {
        Vec3::from(self.color.map(|c| f32::from(c) / 65535.0))
    }

    /// How its light leaves.
    pub fn way(&self) -> Leaving {
        self.way.unpacked()
    }
}

/// How light leaves: a direction on an octahedron's net (Cigolle et al., JCGT 2014), within 5e-5 rad of the one packed,
/// or no direction in particular, for which there are two places beside the net.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct PackedWay([i16; 2]);

impl PackedWay {
    const REFLECTED: PackedWay = PackedWay([i16::MIN; 2]);
    const TRANSMITTED: PackedWay = PackedWay([i16::MIN, 0]);

    fn new(way: Leaving) -> PackedWay {
        let d = match way {
            Leaving::Reflected => return PackedWay::REFLECTED,
            Leaving::Transmitted => return PackedWay::TRANSMITTED,
            Leaving::Along(d) => d,
        };
        let p = Vec2::new(d.x, d.y) / (d.x.abs() + d.y.abs() + d.z.abs());
        let p = if d.z < 0.0 { folded(p) } else { p };
        PackedWay((p * 32767.0).round().to_array().map(|x| x as i16))
    }

    fn unpacked(self) -> Leaving {
        match self {
            PackedWay::REFLECTED => return Leaving::Reflected,
            PackedWay::TRANSMITTED => return Leaving::Transmitted,
            _ => {}
        }
        let p = Vec2::from(self.0.map(f32::from)) / 32767.0;
        let z = 1.0 - p.x.abs() - p.y.abs();
        let p = if z < 0.0 { folded(p) } else { p };
        Leaving::Along(p.extend(z).normalize())
    }
}

/// The lower half of an octahedron, turned out around its upper half.
fn folded(p: Vec2) -> Vec2 {
    (Vec2::ONE - Vec2::new(p.y, p.x).abs()) * Vec2::ONE.copysign(p)
}

/// What direct samples are taken of, and with.
#[derive(Debug, Clone, Copy)]
pub struct TexelLight<'a> {
    /// All texels.
    pub texels: &'a Texels,
    /// Open share of the area of those on the map: where it is below 1, points that another surface lies upon receive
    /// and send out nothing.
    pub open: &'a [f32],
    /// What shines.
    pub emitters: &'a Emitters,
    /// What stands in the way.
    pub visibility: &'a Visibility<'a>,
    /// Whether normals are smooth.
    pub smooth: bool,
}

/// Light at one point of a texel.
#[derive(Debug, Clone, Copy)]
pub struct LitPoint {
    /// Where.
    pub at: Receiver,
    /// One unbiased sample of the irradiance that is stored (lux).
    pub stored: Vec3,
    /// Of it what is soft: without hard shadows.
    pub soft: Vec3,
    /// One of the radiosity rho E that it is reflected with diffusely (lux).
    pub sent: Vec3,
    /// One of the radiosity that it is transmitted with diffusely, on the far side (lux).
    pub sent_beyond: Vec3,
    /// One of the ways that light leaves, which stands for all of them (lux).
    leaving: Vec3,
    /// Which.
    way: Leaving,
}

impl TexelLight<'_> {
    /// Where a point drawn from `texel`, which `sampler` holds, receives light; `None` where it is covered. `u` are
    /// two random numbers. A look for a cover is added to `rays`.
    pub fn point(&self, texel: usize, sampler: &TexelSampler, u: Vec2, rays: &mut u64) -> Option<Receiver> {
        let t = &self.texels.texels[texel];
        let (triangle, uv) = sampler.sample(u);
        let at = Receiver::new(self.visibility.world, triangle, uv, t.back, self.smooth);
        let Some(height) = self.open.get(texel).and_then(|&open| cover_in_part(open, t.area)) else { return Some(at) };
        *rays += 1;
        cover_above(self.visibility, &at, height).is_none().then_some(at)
    }

    /// Where the start of a photon from `texel` receives light: the very point that the sample was taken at.
    pub fn start(&self, texel: usize, start: &StartSlot) -> Receiver {
        let back = self.texels.texels[texel].back;
        Receiver::new(self.visibility.world, start.triangle, start.uv, back, self.smooth)
    }

    /// Where a photon starts that leaves along `way`: on the far side, where that is through the surface.
    pub fn leave(&self, at: &Receiver, way: Vec3) -> Vec3 {
        if way.dot(at.geometric_normal) > 0.0 {
            return at.origin;
        }
        at.beyond(self.visibility.world)
    }

    /// One sample of the light at `at`, all of it from `stream`.
    pub fn any_light(&self, at: Receiver, stream: &mut Stream, rays: &mut u64) -> LitPoint {
        let u: [f32; SAMPLE_DIMENSIONS] = std::array::from_fn(|_| stream.unit());
        self.light(at, |d| u[d], stream, rays)
    }

    /// One sample of the light at `at`, from `SAMPLE_DIMENSIONS` random numbers `u(d)` and what `more` gives.
    pub fn light(&self, at: Receiver, u: impl Fn(usize) -> f32, more: &mut Stream, rays: &mut u64) -> LitPoint {
        let world = self.visibility.world;
        let flags = world.flags[at.triangle as usize];
        let specular = flags.has(SurfaceFlags::SPECULAR) && !flags.has(SurfaceFlags::UNSEEN);
        let pick = if specular { more.unit() } else { 0.0 };
        let light = self.emitters.sample(&at, self.visibility, u, more, pick, rays);
        let (stored, soft) = (light.stored, light.soft);
        let none = Vec3::ZERO;
        let dark = LitPoint { at, stored, soft, sent: none, sent_beyond: none, leaving: none, way: Leaving::Reflected };
        if !light.stored.is_finite() || !light.transported.is_finite() {
            return LitPoint { stored: Vec3::ZERO, soft: Vec3::ZERO, ..dark };
        }
        if light.transported == Vec3::ZERO || flags.has(SurfaceFlags::UNSEEN) {
            return dark;
        }
        if !specular {
            let surface = world.surface(at.triangle, at.uv);
            let [sent, sent_beyond] = [surface.reflected(), surface.transmitted()].map(|s| s * light.transported);
            let lit = LitPoint { sent, sent_beyond, leaving: sent, ..dark };
            return if sent_beyond == Vec3::ZERO { lit } else { lit.by_one_lobe(None, more.unit()) };
        }
        let arriving = -light.ray.towards;
        let met = world.meet(at.triangle, at.uv, arriving);
        let [sent, sent_beyond] = [met.reflected, met.transmitted].map(|share| share * light.transported);
        let bounce = world.bounce((at.triangle, at.uv), &met, arriving, 0.0, || more.unit());
        let thrown = bounce.map(|b| (b.share * light.ray.irradiance(), b.direction));
        LitPoint { sent, sent_beyond, ..dark }.by_one_lobe(thrown, more.unit())
    }
}

impl LitPoint {
    /// One of the lobes is taken for all, in proportion to what it sends out: `thrown` in a direction, or one of the
    /// diffuse ones; `pick` is a random number in [0, 1).
    fn by_one_lobe(self, thrown: Option<(Vec3, Vec3)>, pick: f32) -> LitPoint {
        let (thrown, direction) = thrown.unwrap_or_default();
        let lobes = [
            (self.sent, Leaving::Reflected),
            (thrown, Leaving::Along(direction)),
            (self.sent_beyond, Leaving::Transmitted),
        ];
        let largest = lobes.map(|(lobe, _)| lobe.max_element());
        let all = largest[0] + largest[1] + largest[2];
        let (mut left, mut taken) = (pick * all, None);
        for (k, largest) in largest.into_iter().enumerate().filter(|(_, largest)| *largest > 0.0) {
            // Rounding may leave a little beyond the last.
            taken = Some((k, largest));
            if left < largest {
                break;
            }
            left -= largest;
        }
        let Some((k, largest)) = taken else { return self };
        LitPoint { leaving: lobes[k].0 * (all / largest), way: lobes[k].1, ..self }
    }
}
