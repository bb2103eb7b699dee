//! Rays per second of one thread, and time to build, on a room full of noisy spheres.
//!
//! `cargo bench --bench rays`; the element rate that criterion prints is in rays per second. Rays are incoherent:
//! diffuse bounces from random points of the surface, and shadow rays from there to a point under the ceiling.

#[path = "../tests/shapes/mod.rs"]
mod shapes;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use evenlight::accel::{Accel, Kernel, Ray, offset_origin};
use glam::Vec3;
use shapes::{Random, furnished_room};

const RAYS: usize = 200_000;

/// Diffuse and shadow rays from points of the triangles, every triangle equally likely.
fn rays(triangles: &[[Vec3; 3]]) -> (Vec<Ray>, Vec<Ray>) {
    let mut random = Random::new(5);
    let lamp = Vec3::new(0.1, 0.9, -0.2);
    (0..RAYS)
        .map(|_| {
            let [a, b, c] = triangles[random.index(triangles.len())];
            let (u, v) = (random.unit() * 0.5, random.unit() * 0.5);
            let normal = (b - a).cross(c - a).normalize();
            // The room is seen from within, the spheres from without.
            let normal = if a.abs().max_element() == 1.0 { -normal } else { normal };
            let origin = offset_origin(a + (b - a) * u + (c - a) * v, normal, 1.0);
            let diffuse = (normal + random.direction() * 0.999).normalize();
            let shadow = lamp + random.cube() * 0.1 - origin;
            (Ray { origin, direction: diffuse, t_max: f32::INFINITY }, Ray { origin, direction: shadow, t_max: 0.999 })
        })
        .unzip()
}

fn tracing(c: &mut Criterion) {
    let triangles = furnished_room(20, 27);
    let (diffuse, shadow) = rays(&triangles);
    let mut accel = Accel::build(&triangles, |_| false);
    let mut group = c.benchmark_group(format!("{} triangles", triangles.len()));
    group.throughput(Throughput::Elements(RAYS as u64)).sample_size(10);
    for kernel in [Kernel::Scalar, Kernel::Avx2] {
        accel = accel.with_kernel(kernel);
        if accel.kernel() != kernel {
            continue;
        }
        group.bench_function(format!("closest {kernel:?}"), |bencher| {
            bencher.iter(|| diffuse.iter().filter(|ray| accel.closest(ray).is_some()).count());
        });
        group.bench_function(format!("occluded {kernel:?}"), |bencher| {
            bencher.iter(|| shadow.iter().filter(|ray| accel.occluded(ray)).count());
        });
    }
}

fn building(c: &mut Criterion) {
    let mut group = c.benchmark_group("build");
    group.sample_size(10);
    for spheres in [20, 115] {
        let triangles = furnished_room(spheres, 27);
        group.throughput(Throughput::Elements(triangles.len() as u64));
        group.bench_function(format!("{} triangles", triangles.len()), |bencher| {
            bencher.iter(|| Accel::build(&triangles, |_| false).memory_bytes());
        });
    }
}

criterion_group!(benches, tracing, building);
criterion_main!(benches);
