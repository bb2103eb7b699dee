//! Closed meshes and random numbers for tests and measurements of ray tracing.
#![allow(dead_code, reason = "each test and bench uses a part")]

use glam::{Mat3, Vec3};

/// A fixed sequence of pseudo-random numbers (PCG, O'Neill 2014).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Random {
        Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let word = ((self.0 >> ((self.0 >> 59) + 5)) ^ self.0).wrapping_mul(12_605_985_483_714_917_081);
        ((word >> 43) ^ word) as u32
    }

    /// In [0, 1).
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 8) as f32 / (1 << 24) as f32
    }

    /// In [-1, 1).
    pub fn signed(&mut self) -> f32 {
        2.0 * self.unit() - 1.0
    }

    /// In the cube from -1 to 1.
    pub fn cube(&mut self) -> Vec3 {
        Vec3::new(self.signed(), self.signed(), self.signed())
    }

    /// Uniform on the unit sphere.
    pub fn direction(&mut self) -> Vec3 {
        loop {
            let p = self.cube();
            if (1e-3..1.0).contains(&p.length_squared()) {
                return p.normalize();
            }
        }
    }

    /// Below `n`.
    pub fn index(&mut self, n: usize) -> usize {
        ((u64::from(self.bits()) * n as u64) >> 32) as usize
    }
}

/// The surface of a cube of `n`^3 cells as 12 `n`^2 triangles, with `place` giving the position of each grid point:
/// a function of the point alone, so that neighbours share positions bit for bit.
fn cube_grid(n: i32, place: impl Fn([i32; 3]) -> Vec3) -> Vec<[Vec3; 3]> {
    let mut triangles = Vec::with_capacity(12 * (n * n) as usize);
    for axis in 0..3 {
        for side in [0, n] {
            for i in 0..n {
                for j in 0..n {
                    let at = |di: i32, dj: i32| {
                        let mut p = [0; 3];
                        p[axis] = side;
                        p[(axis + 1) % 3] = i + di;
                        p[(axis + 2) % 3] = j + dj;
                        place(p)
                    };
                    let (a, b, c, d) = (at(0, 0), at(1, 0), at(1, 1), at(0, 1));
                    triangles.extend(if side == 0 { [[a, c, b], [a, d, c]] } else { [[a, b, c], [a, c, d]] });
                }
            }
        }
    }
    triangles
}

/// A sphere around the origin of radius 1 to 1 - `noise` (hashed from the grid point), 12 `n`^2 triangles.
pub fn sphere(n: i32, noise: f32) -> Vec<[Vec3; 3]> {
    cube_grid(n, |p| {
        let direction = Vec3::from_array(p.map(|x| 2.0 * x as f32 / n as f32 - 1.0)).normalize();
        let seed = p.iter().fold(0u64, |h, &x| h * 1_000_003 + x as u64);
        direction * (1.0 - noise * Random::new(seed).unit())
    })
}

/// The box from -`half` to `half`, with `n`^2 quads a side.
pub fn cuboid(n: i32, half: Vec3) -> Vec<[Vec3; 3]> {
    cube_grid(n, |p| Vec3::from_array(p.map(|x| 2.0 * x as f32 / n as f32 - 1.0)) * half)
}

/// Moves every corner; equal corners stay equal.
pub fn moved(triangles: Vec<[Vec3; 3]>, rotation: Mat3, scale: f32, shift: Vec3) -> Vec<[Vec3; 3]> {
    triangles.into_iter().map(|t| t.map(|p| rotation * p * scale + shift)).collect()
}

/// Noisy spheres of 12 `n`^2 triangles each in a room with sides -1 to 1.
pub fn furnished_room(spheres: usize, n: i32) -> Vec<[Vec3; 3]> {
    let mut random = Random::new(7);
    let mut triangles = cuboid(8, Vec3::ONE);
    for _ in 0..spheres {
        let size = 0.05 + 0.15 * random.unit();
        let shift = random.cube() * (0.95 - size);
        let turn = Mat3::from_rotation_y(6.0 * random.unit()) * Mat3::from_rotation_x(6.0 * random.unit());
        triangles.extend(moved(sphere(n, 0.03), turn, size, shift));
    }
    triangles
}
