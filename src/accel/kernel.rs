//! The two inner loops of a traversal, eight boxes or eight triangles at a time, in two versions: portable, and
//! AVX2. Both do the same f32 operations in the same order without fused ones, so they agree bit for bit.

use super::ray::{FAR_FACTOR, PreparedRay};
use super::wide::{Node, Packet, WIDTH};

/// Which instructions traverse the hierarchy. The hits are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// Plain Rust, on any processor.
    Scalar,
    /// 256-bit vectors of x86-64, from 2013 on.
    Avx2,
}

impl Kernel {
    /// The fastest kernel of this processor.
    pub fn best() -> Kernel {
        if Kernel::Avx2.is_available() { Kernel::Avx2 } else { Kernel::Scalar }
    }

    /// True if this processor has the instructions.
    pub fn is_available(self) -> bool {
        match self {
            Kernel::Scalar => true,
            #[cfg(target_arch = "x86_64")]
            Kernel::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("bmi1"),
            #[cfg(not(target_arch = "x86_64"))]
            Kernel::Avx2 => false,
        }
    }
}

/// Eight lanes that hold what a ray needs in every step.
pub(super) trait Lanes {
    /// Which of a node's boxes the ray enters no later than at `limit`: a bit mask, and the distances (at least 0).
    /// The boxes are padded for the ray, so a box that holds a triangle that is hit is never left out.
    fn enter(&self, node: &Node, limit: f32) -> (u32, [f32; WIDTH]);

    /// Which lanes of the packet may be hit: a bit mask. Lanes left out are certainly missed.
    fn may_hit(&self, packet: &Packet) -> u32;
}

/// [`Kernel::Scalar`].
pub(super) struct ScalarLanes<'r>(pub &'r PreparedRay);

impl Lanes for ScalarLanes<'_> {
    #[inline(always)]
    fn enter(&self, node: &Node, limit: f32) -> (u32, [f32; WIDTH]) {
        let ray = self.0;
        let mut near = [0.0; WIDTH];
        let mut far = [limit; WIDTH];
        for axis in 0..3 {
            let (near_row, far_row) = (&node.bounds[ray.near_rows[axis]], &node.bounds[ray.near_rows[axis] ^ 1]);
            for lane in 0..WIDTH {
                let enter = (near_row[lane] - ray.near_origin[axis]) * ray.inverse[axis];
                let leave = (far_row[lane] - ray.far_origin[axis]) * ray.inverse[axis];
                near[lane] = if enter > near[lane] { enter } else { near[lane] };
                far[lane] = if leave < far[lane] { leave } else { far[lane] };
            }
        }
        let mut mask = 0;
        for lane in 0..WIDTH {
            mask |= u32::from(near[lane] <= far[lane] * FAR_FACTOR) << lane;
        }
        (mask, near)
    }

    #[inline(always)]
    fn may_hit(&self, packet: &Packet) -> u32 {
        let ray = self.0;
        let [kx, ky, kz] = ray.axes;
        let mut x = [[0.0; WIDTH]; 3];
        let mut y = [[0.0; WIDTH]; 3];
        for k in 0..3 {
            let corner = &packet.corners[k];
            for lane in 0..WIDTH {
                let z = corner[kz][lane] - ray.origin[kz];
                x[k][lane] = (corner[kx][lane] - ray.origin[kx]) - ray.shear[0] * z;
                y[k][lane] = (corner[ky][lane] - ray.origin[ky]) - ray.shear[1] * z;
            }
        }
        let mut mask = 0;
        for lane in 0..WIDTH {
            let edge = |i: usize, j: usize| x[i][lane] * y[j][lane] - y[i][lane] * x[j][lane];
            let (u, v, w) = (edge(2, 1), edge(0, 2), edge(1, 0));
            let negative = (u < 0.0) | (v < 0.0) | (w < 0.0);
            let positive = (u > 0.0) | (v > 0.0) | (w > 0.0);
            mask |= u32::from(!(negative & positive)) << lane;
        }
        mask
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use avx2::Avx2Lanes;

#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code)]
mod avx2 {
    use super::{FAR_FACTOR, Lanes, Node, Packet, PreparedRay, WIDTH};
    use std::arch::x86_64::*;

    /// [`super::Kernel::Avx2`]. To have one is to know that the processor has AVX2.
    pub(in crate::accel) struct Avx2Lanes<'r> {
        ray: &'r PreparedRay,
        near_origin: [__m256; 3],
        far_origin: [__m256; 3],
        inverse: [__m256; 3],
        /// Origin in the permuted axes of the ray.
        origin: [__m256; 3],
        shear: [__m256; 2],
    }

    impl<'r> Avx2Lanes<'r> {
        /// # Safety
        /// The processor must have AVX2.
        #[inline(always)]
        pub unsafe fn new(ray: &'r PreparedRay) -> Avx2Lanes<'r> {
            // SAFETY: the caller promises AVX2.
            let splat = |x: f32| unsafe { _mm256_set1_ps(x) };
            Avx2Lanes {
                ray,
                near_origin: ray.near_origin.to_array().map(splat),
                far_origin: ray.far_origin.to_array().map(splat),
                inverse: ray.inverse.to_array().map(splat),
                origin: ray.axes.map(|axis| splat(ray.origin[axis])),
                shear: ray.shear.map(splat),
            }
        }
    }

    impl Lanes for Avx2Lanes<'_> {
        #[inline(always)]
        fn enter(&self, node: &Node, limit: f32) -> (u32, [f32; WIDTH]) {
            // SAFETY: AVX2 was promised to `new`; rows are arrays of eight, aligned by the node.
            unsafe {
                let row = |k: usize| _mm256_load_ps(node.bounds[k].as_ptr());
                let mut near = _mm256_setzero_ps();
                let mut far = _mm256_set1_ps(limit);
                for axis in 0..3 {
                    let near_row = self.ray.near_rows[axis];
                    let enter = _mm256_mul_ps(_mm256_sub_ps(row(near_row), self.near_origin[axis]), self.inverse[axis]);
                    let leave =
                        _mm256_mul_ps(_mm256_sub_ps(row(near_row ^ 1), self.far_origin[axis]), self.inverse[axis]);
                    near = _mm256_max_ps(enter, near);
                    far = _mm256_min_ps(leave, far);
                }
                far = _mm256_mul_ps(far, _mm256_set1_ps(FAR_FACTOR));
                let mask = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(near, far)) as u32;
                let mut distances = [0.0; WIDTH];
                _mm256_storeu_ps(distances.as_mut_ptr(), near);
                (mask, distances)
            }
        }

        #[inline(always)]
        fn may_hit(&self, packet: &Packet) -> u32 {
            let [kx, ky, kz] = self.ray.axes;
            // SAFETY: AVX2 was promised to `new`; rows are arrays of eight, aligned by the packet.
            unsafe {
                let row = |k: usize, axis: usize| _mm256_load_ps(packet.corners[k][axis].as_ptr());
                let corner = |k: usize| {
                    let z = _mm256_sub_ps(row(k, kz), self.origin[2]);
                    let x = _mm256_sub_ps(_mm256_sub_ps(row(k, kx), self.origin[0]), _mm256_mul_ps(self.shear[0], z));
                    let y = _mm256_sub_ps(_mm256_sub_ps(row(k, ky), self.origin[1]), _mm256_mul_ps(self.shear[1], z));
                    [x, y]
                };
                let edge = |p: [__m256; 2], q: [__m256; 2]| {
                    _mm256_sub_ps(_mm256_mul_ps(p[0], q[1]), _mm256_mul_ps(p[1], q[0]))
                };
                let (a, b, c) = (corner(0), corner(1), corner(2));
                let (u, v, w) = (edge(c, b), edge(a, c), edge(b, a));
                // Minimum and maximum may drop a NaN, which only lets a lane through or leaves its other two
                // edges to decide.
                let least = _mm256_min_ps(u, _mm256_min_ps(v, w));
                let most = _mm256_max_ps(u, _mm256_max_ps(v, w));
                let zero = _mm256_setzero_ps();
                let negative = _mm256_cmp_ps::<_CMP_LT_OQ>(least, zero);
                let positive = _mm256_cmp_ps::<_CMP_GT_OQ>(most, zero);
                !_mm256_movemask_ps(_mm256_and_ps(negative, positive)) as u32
            }
        }
    }
}
