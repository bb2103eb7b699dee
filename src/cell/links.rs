//! Walls: what may be smoothed together, and what may not.
//!
//! A floor that runs on under a wall is one surface with two lights. Two points of it belong together if a short
//! ray between them, a little above the surface, is free.

use super::choose::Choice;
use super::tree::{Element, Node, SurfaceTree};
use crate::accel::{Accel, Ray, offset_origin};
use glam::DVec3;
use rayon::prelude::*;
use std::ops::Range;

/// Height of the ray over both ends, as a share of their distance ...
const LIFT: f32 = 0.03;

/// ... and more where the surface bends: an arc of 45 degrees is an eighth of its chord high.
const LIFT_BENT: f32 = 0.42;

/// Points of a cell that are tried against each other are one in each of its descendants of this generation.
const GENERATION: u32 = 3;

/// Cells that a speck may join: the first of the nearest with no wall between.
const HOMES: usize = 8;

/// The cells of one half: sets of elements, none of which has a wall through it.
#[derive(Debug, Clone, Default)]
pub struct Cells {
    /// Elements of all cells, one after the other.
    pub order: Vec<u32>,
    /// Of each cell, its part of `order`.
    pub ranges: Vec<Range<usize>>,
}

impl Cells {
    /// Makes cells of a choice of nodes: cut where walls part them, with the specks beside them.
    pub fn new(tree: &SurfaceTree, choice: &Choice, accel: &Accel) -> Cells {
        let parts: Vec<Vec<Vec<u32>>> = choice.cells.par_iter().map(|node| part(tree, node, accel)).collect();
        // Which of the cells begin within a node of the choice.
        let mut first = Vec::with_capacity(parts.len() + 1);
        let mut count = 0;
        for p in &parts {
            first.push(count);
            count += p.len();
        }
        first.push(count);
        let mut parts: Vec<Vec<u32>> = parts.into_iter().flatten().collect();
        let middles: Vec<&Element> =
            parts.par_iter().map(|p| middle_of(p.iter().map(|&k| &tree.elements[k as usize]))).collect();
        let specks: Vec<(Vec<u32>, &Node)> = choice
            .specks
            .par_iter()
            .flat_map_iter(|(speck, sibling)| part(tree, speck, accel).into_iter().map(move |p| (p, sibling)))
            .collect();
        let homes: Vec<Option<usize>> = specks
            .par_iter()
            .map(|(speck, sibling)| {
                let at = middle_of(speck.iter().map(|&k| &tree.elements[k as usize]));
                let within = |from: usize| choice.cells.partition_point(|n| n.elements.start < from);
                let range = first[within(sibling.elements.start)]..first[within(sibling.elements.end)];
                let distance = |i: &usize| middles[*i].position.distance_squared(at.position);
                let mut near: Vec<usize> = range.collect();
                let by_distance = |a: &usize, b: &usize| distance(a).total_cmp(&distance(b)).then(a.cmp(b));
                if near.len() > HOMES {
                    near.select_nth_unstable_by(HOMES, by_distance);
                    near.truncate(HOMES);
                }
                near.sort_unstable_by(by_distance);
                near.into_iter().find(|&i| linked(at, middles[i], accel))
            })
            .collect();
        for ((speck, _), home) in specks.into_iter().zip(homes) {
            match home {
                Some(i) => parts[i].extend(speck),
                // Behind walls on all sides: alone after all.
                None => parts.push(speck),
            }
        }
        let mut cells = Cells { order: Vec::with_capacity(tree.elements.len()), ranges: Vec::new() };
        for elements in parts {
            let start = cells.order.len();
            cells.order.extend(elements);
            cells.ranges.push(start..cells.order.len());
        }
        cells
    }

    /// Number of cells.
    pub fn len(&self) -> usize {
        self.ranges.len()
    }

    /// The cell that each element is in.
    pub fn by_element(&self) -> Vec<u32> {
        let mut out = vec![0; self.order.len()];
        for (cell, range) in self.ranges.iter().enumerate() {
            self.order[range.clone()].iter().for_each(|&k| out[k as usize] = cell as u32);
        }
        out
    }
}

/// True if two texels are surrounded alike and nothing stands between them.
pub fn linked(a: &Element, b: &Element, accel: &Accel) -> bool {
    if a.setting != b.setting {
        return false;
    }
    let distance = a.position.distance(b.position);
    let lift = distance * (LIFT + LIFT_BENT * (1.0 - a.normal.dot(b.normal)).clamp(0.0, 1.0));
    let end = |e: &Element| offset_origin(e.position, e.normal, 1.0) + e.normal * lift;
    let (from, to) = (end(a), end(b));
    !accel.occluded(&Ray { origin: from, direction: to - from, t_max: 1.0 })
}

/// The elements of a node, in sets that see each other, perhaps around corners.
fn part(tree: &SurfaceTree, node: &Node, accel: &Accel) -> Vec<Vec<u32>> {
    let all = || (node.elements.start as u32..node.elements.end as u32).collect::<Vec<u32>>();
    let mut below = vec![node.clone()];
    for _ in 0..GENERATION {
        below = below.iter().flat_map(|n| tree.children(n).map_or_else(|| vec![n.clone()], |c| c.to_vec())).collect();
    }
    if below.len() < 2 {
        return vec![all()];
    }
    let posts: Vec<&Element> = below.iter().map(|n| middle(tree, n.elements.clone())).collect();
    let mut group: Vec<usize> = (0..posts.len()).collect();
    for i in 0..posts.len() {
        for j in 0..i {
            if group[i] != group[j] && linked(posts[i], posts[j], accel) {
                let (old, new) = (group[i].max(group[j]), group[i].min(group[j]));
                group.iter_mut().filter(|g| **g == old).for_each(|g| *g = new);
            }
        }
    }
    if group.iter().all(|&g| g == 0) {
        return vec![all()];
    }
    // One more set for what no post sees.
    let mut sets: Vec<Vec<u32>> = vec![Vec::new(); posts.len() + 1];
    for k in node.elements.clone() {
        let e = &tree.elements[k];
        let mut near: Vec<(f32, usize)> =
            posts.iter().enumerate().map(|(i, p)| (p.position.distance_squared(e.position), i)).collect();
        near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let seen = near.iter().find(|n| linked(e, posts[n.1], accel)).map_or(posts.len(), |n| group[n.1]);
        sets[seen].push(k as u32);
    }
    sets.retain(|s| !s.is_empty());
    sets
}

/// The element nearest to the middle of a run of them.
fn middle(tree: &SurfaceTree, range: Range<usize>) -> &Element {
    middle_of(tree.elements[range].iter())
}

/// The element nearest to the middle of some: at least one.
pub fn middle_of<'e>(elements: impl Iterator<Item = &'e Element> + Clone) -> &'e Element {
    let (mut sum, mut area) = (DVec3::ZERO, 0.0);
    for e in elements.clone() {
        sum += f64::from(e.area) * e.position.as_dvec3();
        area += f64::from(e.area);
    }
    let centre = (sum / area).as_vec3();
    let distance = |e: &&Element| e.position.distance_squared(centre);
    elements.min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("some elements")
}
