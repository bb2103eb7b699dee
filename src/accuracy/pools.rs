//! Texels too small to catch photons on their own.
//!
//! A sliver at a chart's border, or a chart smaller than a texel, is hit by almost no photon, and each hit
//! counts for a huge irradiance: its estimate is right on average and useless. Such a texel takes its
//! indirect light from a *pool*: all texels of the same node around it that face the same way, in the smallest
//! cube that holds enough surface. Texels of ordinary size keep their own light.

use crate::atlas::{TexelSampler, Texels};
use crate::scene::World;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::ops::Range;

/// A texel is small below this share of the largest of its chart ...
const SMALL_IN_CHART: f32 = 1.0 / 8.0;

/// ... or of the square of the map's usual pitch.
const SMALL_ON_MAP: f32 = 1.0 / 32.0;

/// A pool is large enough from this many usual texels on.
const ENOUGH: f64 = 1.0;

/// Cubes of 1, 2, 4, ... pitches are tried, so many of them.
const LEVELS: u32 = 4;

/// Pools of small texels.
#[derive(Debug, Clone, Default)]
pub struct Pools {
    /// (texel, pool) of every small texel, by texel.
    assigned: Vec<(u32, u32)>,
    /// Range of `members` of each pool.
    ranges: Vec<Range<u32>>,
    members: Vec<u32>,
}

impl Pools {
    /// Finds small texels and their pools. `instance` is the node of each texel of the map, `open` the open
    /// share of its area, `pitch` the usual distance of texels [frame units] of a node of density 1.
    pub fn new(world: &World, texels: &Texels, instance: &[u32], open: &[f32], pitch: f64) -> Pools {
        let map = &texels.texels[..texels.mapped];
        let charts = map.iter().map(|t| t.chart as usize + 1).max().unwrap_or(0);
        let mut largest = vec![0f32; charts];
        map.iter().for_each(|t| largest[t.chart as usize] = largest[t.chart as usize].max(t.area));
        let usual = |i: usize| pitch / f64::from(world.scene.instances[instance[i] as usize].density);
        let mut small: Vec<u32> = (0..map.len())
            .filter(|&i| {
                let on_map = SMALL_ON_MAP * usual(i).powi(2) as f32;
                open[i] > 0.0 && map[i].area * open[i] < on_map.max(SMALL_IN_CHART * largest[map[i].chart as usize])
            })
            .map(|i| i as u32)
            .collect();
        let mut pools = Pools::default();
        if small.is_empty() {
            return pools;
        }
        let places: Vec<(Vec3, u8)> = (0..map.len())
            .into_par_iter()
            .map_init(TexelSampler::default, |sampler, i| {
                sampler.load(texels, i);
                let (triangle, uv) = sampler.sample(Vec2::splat(0.5));
                let normal = world.normals[triangle as usize] * if map[i].back { -1.0 } else { 1.0 };
                (world.position(triangle, uv), facing(normal))
            })
            .collect();
        for level in 0..LEVELS {
            let key = |i: usize| {
                let side = usual(i) * f64::from(1 << level);
                let at = places[i].0.to_array().map(|x| (f64::from(x) / side).floor() as i32);
                (instance[i], places[i].1, at)
            };
            let mut order: Vec<_> = (0..map.len()).into_par_iter().map(|i| (key(i), i as u32)).collect();
            order.par_sort_unstable();
            // Pool of a run of `order`, by where the run begins.
            let mut known: HashMap<usize, u32> = HashMap::new();
            small.retain(|&texel| {
                let k = key(texel as usize);
                let from = order.partition_point(|o| o.0 < k);
                let to = from + order[from..].partition_point(|o| o.0 == k);
                let group = &order[from..to];
                let area = |&(_, i): &(_, u32)| f64::from(map[i as usize].area) * f64::from(open[i as usize]);
                let enough = group.iter().map(area).sum::<f64>() >= ENOUGH * usual(texel as usize).powi(2);
                if enough || level + 1 == LEVELS {
                    let pool = *known.entry(from).or_insert_with(|| {
                        let first = pools.members.len() as u32;
                        pools.members.extend(group.iter().map(|o| o.1).filter(|&i| open[i as usize] > 0.0));
                        pools.ranges.push(first..pools.members.len() as u32);
                        pools.ranges.len() as u32 - 1
                    });
                    pools.assigned.push((texel, pool));
                    return false;
                }
                true
            });
        }
        pools.assigned.sort_unstable();
        pools
    }

    /// Number of texels that take their indirect light from a pool.
    pub fn len(&self) -> usize {
        self.assigned.len()
    }

    /// True where every texel has its own light.
    pub fn is_empty(&self) -> bool {
        self.assigned.is_empty()
    }

    /// Replaces the value of each small texel by the area-weighted mean of its pool, taken from `values` as
    /// they came in. `area` gives the weight of a texel.
    pub fn apply(&self, values: &mut [Vec3], area: impl Fn(usize) -> f32 + Sync) {
        let means: Vec<Vec3> = self
            .ranges
            .par_iter()
            .map(|range| {
                let (mut sum, mut weight) = (Vec3::ZERO, 0.0);
                for &i in &self.members[range.start as usize..range.end as usize] {
                    let a = area(i as usize);
                    sum += values[i as usize] * a;
                    weight += a;
                }
                if weight > 0.0 { sum / weight } else { Vec3::ZERO }
            })
            .collect();
        for &(texel, pool) in &self.assigned {
            values[texel as usize] = means[pool as usize];
        }
    }
}

/// Which of the six axis directions a normal is nearest to.
fn facing(n: Vec3) -> u8 {
    let a = n.abs();
    let axis = if a.x >= a.y && a.x >= a.z {
        0
    } else if a.y >= a.z {
        1
    } else {
        2
    };
    axis * 2 + u8::from(n[axis as usize] < 0.0)
}
