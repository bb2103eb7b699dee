//! Radiance on the faces of a cube.

use crate::cache::Digest;
use glam::{Quat, Vec3};
use std::sync::Arc;

/// Where a face lies: its axis, and the directions in which its columns and rows go.
struct Face {
    axis: Vec3,
    right: Vec3,
    down: Vec3,
}

/// +X, -X, +Y, -Y, +Z, -Z as seen from inside, in right-handed space: the faces of OpenGL (4.6, table 8.19) turned
/// over left to right, for its cube maps are left-handed.
const FACES: [Face; 6] = [
    Face { axis: Vec3::X, right: Vec3::Z, down: Vec3::NEG_Y },
    Face { axis: Vec3::NEG_X, right: Vec3::NEG_Z, down: Vec3::NEG_Y },
    Face { axis: Vec3::Y, right: Vec3::NEG_X, down: Vec3::Z },
    Face { axis: Vec3::NEG_Y, right: Vec3::NEG_X, down: Vec3::NEG_Z },
    Face { axis: Vec3::Z, right: Vec3::NEG_X, down: Vec3::NEG_Y },
    Face { axis: Vec3::NEG_Z, right: Vec3::X, down: Vec3::NEG_Y },
];

/// Radiance of the surroundings on the six faces of a cube without end. It is constant within a texel.
#[derive(Debug, Clone)]
pub struct CubeMap {
    /// Texels along an edge, from 1.
    size: usize,
    /// Radiance (nit), linear Rec. 709, non-negative and finite: +X, -X, +Y, -Y, +Z, -Z, each row-major from its top
    /// left as seen from inside.
    radiance: Arc<[Vec3]>,
    cube_from_world: Quat,
}

impl CubeMap {
    /// Faces +X, -X, +Y, -Y, +Z, -Z of `size` x `size` texels each, as seen from inside, row-major from the top left;
    /// turned in the world by `world_from_cube`, of length 1.
    ///
    /// # Panics
    /// `radiance` has not 6 `size`^2 texels, or none.
    pub fn new(size: usize, radiance: Arc<[Vec3]>, world_from_cube: Quat) -> CubeMap {
        assert!(size > 0 && radiance.len() == 6 * size * size, "{} texels on faces of {size}", radiance.len());
        CubeMap { size, radiance, cube_from_world: world_from_cube.conjugate() }
    }

    /// The same faces with other texels, turned by `turn`.
    pub(crate) fn turned(&self, turn: Quat, radiance: Arc<[Vec3]>) -> CubeMap {
        CubeMap { size: self.size, radiance, cube_from_world: self.cube_from_world * turn.conjugate() }
    }

    /// Adds its radiance and how it is turned.
    pub(crate) fn feed(&self, digest: &mut Digest) {
        digest.debug(&(self.size, self.cube_from_world));
        digest.values(&self.radiance);
    }

    /// Texels along an edge of a face.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Radiance (nit) of all faces, row by row.
    pub(crate) fn texels(&self) -> &[Vec3] {
        &self.radiance
    }

    /// Index in [`texels`](Self::texels) of what the direction `w` looks at.
    pub(crate) fn texel(&self, w: Vec3) -> usize {
        let (face, at) = self.project(w);
        let place = |t: f32| (((t + 1.0) * 0.5 * self.size as f32) as usize).min(self.size - 1);
        (face * self.size + place(at[1])) * self.size + place(at[0])
    }

    /// Direction (world space, unit) of a place on a face: `x` and `y` in texels from its top left.
    pub(crate) fn direction(&self, face: usize, x: f32, y: f32) -> Vec3 {
        let [u, v] = [x, y].map(|t| t / self.size as f32 * 2.0 - 1.0);
        let Face { axis, right, down } = &FACES[face];
        self.cube_from_world.conjugate() * (*axis + *right * u + *down * v).normalize()
    }

    /// Distance from the centre of a cube of half edge 1 to its surface along `w`, and to the centre of the texel
    /// there: what an area on a face is in solid angle goes with its cube.
    pub(crate) fn distances(&self, w: Vec3) -> [f32; 2] {
        let (_, [u, v]) = self.project(w);
        let n = self.size as f32;
        let centre = |t: f32| (((t + 1.0) * 0.5 * n).floor().min(n - 1.0) + 0.5) / n * 2.0 - 1.0;
        [[u, v], [centre(u), centre(v)]].map(|[u, v]| (1.0 + u * u + v * v).sqrt())
    }

    /// The face that `w` looks at, and where on it in [-1, 1]^2, rightwards and downwards.
    fn project(&self, w: Vec3) -> (usize, [f32; 2]) {
        let w = self.cube_from_world * w;
        let a = w.abs();
        let k = if a.x >= a.y && a.x >= a.z { 0 } else { 1 + usize::from(a.z > a.y) };
        let face = 2 * k + usize::from(w[k] < 0.0);
        let Face { right, down, .. } = &FACES[face];
        (face, [right, down].map(|axis| (axis.dot(w) / a[k]).clamp(-1.0, 1.0)))
    }

    /// Solid angle of a texel of any face [sr], as that of its centre.
    pub(crate) fn solid_angle(&self, x: usize, y: usize) -> f64 {
        let n = self.size as f64;
        let [u, v] = [x, y].map(|t| (t as f64 + 0.5) / n * 2.0 - 1.0);
        let squared = 1.0 + u * u + v * v;
        4.0 / (n * n * squared * squared.sqrt())
    }

    /// Mean over all directions (nit).
    pub fn mean(&self) -> Vec3 {
        let n = self.size;
        let mut sum = glam::DVec3::ZERO;
        let mut solid = 0.0;
        for (i, radiance) in self.radiance.iter().enumerate() {
            let omega = self.solid_angle(i % n, i / n % n);
            sum += radiance.as_dvec3() * omega;
            solid += omega;
        }
        (sum / solid).as_vec3()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Face and place by the table of OpenGL: major axis, then sc and tc over ma. Turned over, s is 1 - s.
    fn by_the_table(w: Vec3) -> (usize, f32, f32) {
        let (x, y, z) = (w.x, w.y, w.z);
        let (face, sc, tc, ma) = match w.abs().to_array() {
            [a, b, c] if a >= b && a >= c => {
                if x > 0.0 {
                    (0, -z, -y, a)
                } else {
                    (1, z, -y, a)
                }
            }
            [_, b, c] if b >= c => {
                if y > 0.0 {
                    (2, x, z, b)
                } else {
                    (3, x, -z, b)
                }
            }
            [_, _, c] => {
                if z > 0.0 {
                    (4, x, -y, c)
                } else {
                    (5, -x, -y, c)
                }
            }
        };
        (face, 1.0 - (sc / ma + 1.0) / 2.0, (tc / ma + 1.0) / 2.0)
    }

    #[test]
    fn faces_lie_as_the_table_says() {
        let n = 8;
        let map = CubeMap::new(n, vec![Vec3::ONE; 6 * n * n].into(), Quat::IDENTITY);
        for i in 0..400 {
            let t = i as f32;
            let w = Vec3::new((t * 0.713).sin(), (t * 1.317).cos(), (t * 2.171 + 1.0).sin());
            if w.length() < 0.1 {
                continue;
            }
            let (face, s, t) = by_the_table(w);
            let texel = (face * n + (t * n as f32) as usize) * n + (s * n as f32) as usize;
            assert_eq!(map.texel(w), texel, "{w}");
            let back = map.direction(face, s * n as f32, t * n as f32);
            assert!(back.distance(w.normalize()) < 1e-5, "{w}: {back}");
        }
    }

    /// Turned by +90 degrees about +Y, what was at +Z is at +X.
    #[test]
    fn the_rotation_turns_the_surroundings() {
        let radiance: Arc<[Vec3]> = (0..6).map(|face| Vec3::splat(face as f32)).collect();
        let map = CubeMap::new(1, radiance, Quat::from_rotation_y(std::f32::consts::FRAC_PI_2));
        assert_eq!([Vec3::X, Vec3::Y, Vec3::Z].map(|w| map.texel(w)), [4, 2, 1]);
    }
}
