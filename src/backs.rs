//! Where light meets the backs of one-sided surfaces and ends: a hole, or a face turned the wrong way.
//!
//! In: what photons left on backs, and lamps. Out: the nodes that take up much light so, and how much falls on each of
//! their triangles. Of direct light that of point and spot lights and of surfaces counts: the sun and the sky shine on the
//! outer sides of every room whose walls are one-sided, and nothing is wrong with that.

use crate::error::Warning;
use crate::light::{Emitters, Receiver, SAMPLE_DIMENSIONS, Visibility};
use crate::sampling::{Stream, hash_seed, sobol, uniform_triangle, unit_f32};
use crate::scene::{Scene, SurfaceFlags, World};
use crate::solve::Solution;
use glam::Vec2;
use rayon::prelude::*;

/// Code of the warnings.
pub const LIT_FROM_BEHIND: &str = "lit-from-behind";

/// Share of all photons' flux that the backs of one node must meet to be worth a warning, ...
const REFLECTED_SHARE: f64 = 0.005;

/// ... and of all direct light of lamps, which a lamp outside a wall or above a ceiling sends there as well.
const DIRECT_SHARE: f64 = 0.02;

/// Points that tell the direct light, spread over the area of all surfaces; each is looked at from both sides.
const POINTS: usize = 1 << 15;

/// Each triangle of the nodes found is looked at in so many points, so that a picture has no gaps, if they are not too many.
const POINTS_EACH: usize = 8;
const MOST_TRIANGLES: usize = 1 << 16;

/// Random numbers of these points.
const STREAM: u64 = 0x6261_636b;

/// Light on backs.
#[derive(Debug, Clone, Default)]
pub struct LitBacks {
    /// Nodes that are worth a warning, in the order of the scene.
    pub nodes: Vec<LitNode>,
    /// Irradiance (lux, mean of the channels) on the back of each triangle of the world; empty where no node is worth a
    /// warning.
    pub irradiance: Vec<f32>,
}

/// A node lit from behind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LitNode {
    /// Scene instance.
    pub instance: usize,
    /// Share of all light that photons carry which ends on its backs.
    pub reflected: f64,
    /// Share of the direct light of lamps that does.
    pub direct: f64,
}

impl LitBacks {
    /// What `solution` and the lamps of `emitters` say of the backs of the world.
    pub fn new(visibility: &Visibility, emitters: &Emitters, solution: &Solution, seed: u64) -> LitBacks {
        let world = visibility.world;
        let lamps = Lamps { visibility, emitters, seed };
        let (mut direct, all) = lamps.on_backs();
        let mut nodes: Vec<LitNode> = (0..world.scene.instances.len())
            .map(|instance| LitNode { instance, reflected: 0.0, direct: 0.0 })
            .collect();
        let reflected = solution.reflected.max(f64::MIN_POSITIVE);
        for (r, (&flux, &lux)) in world.refs.iter().zip(solution.back_flux.iter().zip(&direct)) {
            let node = &mut nodes[r.instance as usize];
            node.reflected += flux / reflected;
            node.direct += if all > 0.0 { lux / all } else { 0.0 };
        }
        nodes.retain(|n| n.reflected > REFLECTED_SHARE || n.direct > DIRECT_SHARE);
        if nodes.is_empty() {
            return LitBacks::default();
        }
        let lit = |t: &u32| nodes.iter().any(|n| n.instance == world.refs[*t as usize].instance as usize);
        let triangles: Vec<u32> = (0..world.len() as u32).filter(|&t| ends_light(world, t)).filter(lit).collect();
        if all > 0.0 && triangles.len() <= MOST_TRIANGLES {
            triangles.iter().zip(lamps.each(&triangles)).for_each(|(&t, flux)| direct[t as usize] = flux);
        }
        let of = |t: usize| {
            let flux = direct[t] + solution.back_flux[t] / 3.0;
            if flux > 0.0 { (flux / world.area(t as u32)) as f32 } else { 0.0 }
        };
        LitBacks { nodes, irradiance: (0..world.len()).map(of).collect() }
    }

    /// One warning for each node, in their order.
    pub fn warnings<'a>(&'a self, scene: &'a Scene) -> impl Iterator<Item = Warning> + 'a {
        self.nodes.iter().map(|n| {
            let percent = |share: f64, of: &str| format!("{:.1} % of all {of}", 100.0 * share);
            let mut light = Vec::new();
            if n.reflected > REFLECTED_SHARE {
                light.push(percent(n.reflected, "reflected light"));
            }
            if n.direct > DIRECT_SHARE {
                light.push(percent(n.direct, "direct light of lamps"));
            }
            let what = format!(
                "node {}: {} meets backs of its one-sided surfaces and is absorbed; turn its faces or make its material \
                 double-sided",
                scene.instances[n.instance].name,
                light.join(" and ")
            );
            Warning::new(LIT_FROM_BEHIND, what)
        })
    }
}

/// Whether light ends on the back of a triangle.
pub fn ends_light(world: &World, triangle: u32) -> bool {
    let flags = world.flags[triangle as usize];
    ![SurfaceFlags::DOUBLE_SIDED, SurfaceFlags::PASSES_LIGHT, SurfaceFlags::DEGENERATE, SurfaceFlags::UNSEEN]
        .into_iter()
        .any(|f| flags.has(f))
}

/// Light of lamps on surface.
struct Lamps<'a> {
    visibility: &'a Visibility<'a>,
    emitters: &'a Emitters,
    seed: u64,
}

impl Lamps<'_> {
    /// Flux on the back of each triangle where it ends there, and on these and all fronts [lux x frame units squared, mean of
    /// the channels].
    fn on_backs(&self) -> (Vec<f64>, f64) {
        let world = self.visibility.world;
        let (mut backs, mut all, mut sum) = (vec![0.0; world.len()], 0.0, 0.0);
        let met = |t: u32| !world.flags[t as usize].has(SurfaceFlags::DEGENERATE);
        let upto: Vec<f64> = (0..world.len() as u32)
            .map(|t| {
                sum += if met(t) { world.area(t) } else { 0.0 };
                sum
            })
            .collect();
        if sum <= 0.0 || !self.emitters.has_lamps() {
            return (backs, all);
        }
        let look = |k: usize| {
            let at = (k as f64 + 0.5) / POINTS as f64 * sum;
            let triangle = upto.partition_point(|&c| c <= at).min(upto.len() - 1) as u32;
            let back = if ends_light(world, triangle) { self.light(triangle, true, k) } else { 0.0 };
            (triangle, self.light(triangle, false, k), back)
        };
        let looks: Vec<(u32, f64, f64)> = (0..POINTS).into_par_iter().map(look).collect();
        let area = sum / POINTS as f64;
        for (triangle, front, back) in looks {
            all += (front + back) * area;
            backs[triangle as usize] += back * area;
        }
        (backs, all)
    }

    /// Looks at each of `triangles` in turn: their fluxes as [`on_backs`](Self::on_backs) has them.
    fn each(&self, triangles: &[u32]) -> Vec<f64> {
        let of = |&t: &u32| {
            let sum: f64 = (0..POINTS_EACH).map(|k| self.light(t, true, t as usize * POINTS_EACH + k)).sum();
            sum / POINTS_EACH as f64 * self.visibility.world.area(t)
        };
        triangles.par_iter().map(of).collect()
    }

    /// Irradiance (lux, mean of the channels) at the `k`-th point, on a triangle.
    fn light(&self, triangle: u32, back: bool, k: usize) -> f64 {
        const { assert!(SAMPLE_DIMENSIONS + 2 <= crate::sampling::DIMENSIONS) };
        let scramble = hash_seed(&[self.seed, STREAM]);
        let u = |d: usize| unit_f32(sobol(k as u32, d, scramble));
        let mut stream = Stream::new(u64::from(hash_seed(&[self.seed, STREAM, k as u64])));
        let at = Receiver::new(self.visibility.world, triangle, uniform_triangle(Vec2::new(u(0), u(1))), back, false);
        let light = self.emitters.lamps(&at, self.visibility, |d| u(d + 2), &mut stream, &mut 0);
        f64::from(light.element_sum()) / 3.0
    }
}
