//! Rays against triangles: no leak, no self-hit, and the same hits as brute force, whichever kernel runs.

mod shapes;

use evenlight::accel::{Accel, Hit, Kernel, Ray, offset_origin};
use glam::{DVec3, Mat3, Vec3};
use shapes::{Random, cuboid, furnished_room, moved, sphere};
use std::ops::ControlFlow;

const RAYS: usize = 200_000;

/// The same triangles for every kernel that this processor has.
fn every_kernel(triangles: &[[Vec3; 3]]) -> Vec<Accel> {
    [Kernel::Scalar, Kernel::Avx2]
        .into_iter()
        .filter(|kernel| kernel.is_available())
        .map(|kernel| Accel::build(triangles, |_| false).with_kernel(kernel))
        .collect()
}

fn ray(origin: Vec3, direction: Vec3) -> Ray {
    Ray { origin, direction, t_max: f32::INFINITY }
}

/// A hit as bits, so that -0 and NaN cannot hide.
fn bits(hit: Option<Hit>) -> Option<[u32; 4]> {
    hit.map(|h| [h.triangle, h.t.to_bits(), h.u.to_bits(), h.v.to_bits()])
}

fn all_hits(accel: &Accel, ray: &Ray) -> Vec<Hit> {
    let mut hits = Vec::new();
    let stopped = accel.visit_hits(ray, |hit| {
        hits.push(hit);
        ControlFlow::Continue(())
    });
    assert!(!stopped);
    hits.sort_by_key(|hit| hit.triangle);
    hits
}

/// Asks every kernel everything, checks that the answers agree, and returns them.
fn ask(accels: &[Accel], ray: &Ray) -> (Option<Hit>, Vec<Hit>) {
    let hit = accels[0].closest(ray);
    let hits = all_hits(&accels[0], ray);
    let list = |hits: &[Hit]| hits.iter().map(|&h| bits(Some(h))).collect::<Vec<_>>();
    for accel in accels {
        assert_eq!(bits(accel.closest(ray)), bits(hit), "{:?} on {ray:?}", accel.kernel());
        assert_eq!(accel.occluded(ray), hit.is_some(), "{:?} on {ray:?}", accel.kernel());
        assert_eq!(list(&all_hits(accel, ray)), list(&hits), "{:?} on {ray:?}", accel.kernel());
        assert_eq!(accel.visit_hits(ray, |_| ControlFlow::Break(())), hit.is_some());
    }
    (hit, hits)
}

/// The watertight test over all triangles one after the other, for origins within twice the extent: rounded corners
/// in f32, edge functions in f64. Directions must have their largest component in [1, 2), so that no scaling is due.
fn brute_force(triangles: &[[Vec3; 3]], ray: &Ray) -> Vec<Hit> {
    let d = ray.direction;
    let a = d.abs();
    let kz = if a.x > a.y && a.x > a.z {
        0
    } else if a.y > a.z {
        1
    } else {
        2
    };
    let (kx, ky) = if d[kz] < 0.0 { ((kz + 2) % 3, (kz + 1) % 3) } else { ((kz + 1) % 3, (kz + 2) % 3) };
    let (sx, sy) = (d[kx] / d[kz], d[ky] / d[kz]);
    let mut hits = Vec::new();
    for (id, triangle) in triangles.iter().enumerate() {
        let [a, b, c] = triangle.map(|p| {
            let p = p - ray.origin;
            DVec3::new((p[kx] - sx * p[kz]).into(), (p[ky] - sy * p[kz]).into(), p[kz].into())
        });
        let edges = [c.x * b.y - c.y * b.x, a.x * c.y - a.y * c.x, b.x * a.y - b.y * a.x];
        let sum: f64 = edges[0] + edges[1] + edges[2];
        let one_side = edges.iter().all(|&e| e >= 0.0) || edges.iter().all(|&e| e <= 0.0);
        let t = ((edges[0] * a.z + edges[1] * b.z + edges[2] * c.z) / (sum * f64::from(d[kz]))) as f32;
        if one_side && sum != 0.0 && t > 0.0 && t < ray.t_max {
            let u = (edges[1] / sum) as f32;
            hits.push(Hit { triangle: id as u32, t, u, v: ((edges[2] / sum) as f32).min(1.0 - u) });
        }
    }
    hits
}

/// A direction with its largest component in [1, 2), often with components of 0.
fn scaled_direction(random: &mut Random) -> Vec3 {
    let mut d = random.cube();
    for axis in 0..3 {
        if random.index(8) == 0 {
            d[axis] = 0.0f32.copysign(random.signed());
        }
    }
    let axis = random.index(3);
    d[axis] = (1.0 + random.unit()).min(1.999).copysign(random.signed());
    d
}

#[test]
fn same_hits_as_brute_force() {
    let mut random = Random::new(1);
    // Soups of large, of small and of flat triangles, on a grid so that many touch and many distances are equal.
    for (count, size, grid) in
        [(1, 1.0, 0.0), (7, 1.0, 4.0), (40, 1.0, 4.0), (500, 0.5, 16.0), (3000, 0.1, 0.0), (3000, 0.3, 8.0)]
    {
        let snap = |p: Vec3| if grid > 0.0 { (p * grid).round() / grid } else { p };
        let triangles: Vec<[Vec3; 3]> = (0..count)
            .map(|_| {
                let p = random.cube() * (1.0 - size * 0.5);
                [p, p + random.cube() * size, p + random.cube() * size].map(snap)
            })
            .collect();
        let accels = every_kernel(&triangles);
        let mut met = 0;
        for _ in 0..3000 {
            let t_max = if random.index(2) == 0 { f32::INFINITY } else { 2.0 * random.unit() };
            let ray = Ray { origin: snap(random.cube()), direction: scaled_direction(&mut random), t_max };
            let expected = brute_force(&triangles, &ray);
            let nearest =
                expected.iter().min_by(|a, b| (a.t, a.triangle).partial_cmp(&(b.t, b.triangle)).expect("no NaN"));
            let (hit, hits) = ask(&accels, &ray);
            assert_eq!(bits(hit), bits(nearest.copied()), "{ray:?}");
            assert_eq!(hits, expected, "{ray:?}");
            met += expected.len();
        }
        assert!(met > 20, "{count} triangles were met {met} times: the soup tests nothing");
    }
}

/// A corner, a point on an edge or a point inside, of a random triangle.
fn target(triangles: &[[Vec3; 3]], random: &mut Random) -> Vec3 {
    let mut t = triangles[random.index(triangles.len())];
    t.rotate_left(random.index(3));
    let [a, b, c] = t;
    match random.index(3) {
        0 => a,
        1 => a + (b - a) * random.unit(),
        _ => {
            let (u, v) = (random.unit(), random.unit());
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            a + (b - a) * u + (c - a) * v
        }
    }
}

/// Distance of a hit's point on its triangle from the ray's line, in exact enough arithmetic.
fn distance_to_line(triangles: &[[Vec3; 3]], ray: &Ray, hit: &Hit) -> f64 {
    let [a, b, c] = triangles[hit.triangle as usize].map(Vec3::as_dvec3);
    let p = a + (b - a) * f64::from(hit.u) + (c - a) * f64::from(hit.v) - ray.origin.as_dvec3();
    p.cross(ray.direction.as_dvec3().normalize()).length()
}

/// No ray may leave a closed mesh: from `inside`, aimed at its vertices, edges and faces; nor may one that comes from
/// far away miss it, if it passes well inside the ball of radius `inner` around `centre` (0: not asked).
fn check_closed(
    name: &str,
    triangles: &[[Vec3; 3]],
    centre: Vec3,
    inner: f32,
    mut inside: impl FnMut(&mut Random) -> Vec3,
) {
    let accels = every_kernel(triangles);
    let extent = triangles.iter().flatten().fold(0.0f32, |m, p| m.max(p.abs().max_element()));
    let tolerance = 30.0 * f64::from(f32::EPSILON * extent);
    let mut random = Random::new(2);
    let check = |ray: Ray, what: &str| {
        let hit = accels[0].closest(&ray);
        for accel in &accels {
            let kernel = accel.kernel();
            assert!(accel.occluded(&ray), "{name}: {kernel:?} lost {ray:?} {what}");
            assert_eq!(bits(accel.closest(&ray)), bits(hit), "{name}: {kernel:?} differs on {ray:?} {what}");
        }
        let hit = hit.unwrap_or_else(|| panic!("{name}: lost {ray:?} {what}"));
        let off = distance_to_line(triangles, &ray, &hit);
        assert!(off <= tolerance, "{name}: {hit:?} is {off} off {ray:?} {what}");
    };
    for _ in 0..RAYS {
        let origin = inside(&mut random);
        check(ray(origin, target(triangles, &mut random) - origin), "from inside");
    }
    let mut aimed = 0;
    while inner > 0.0 && aimed < RAYS {
        let distance = 10f32.powf(3.0 + 3.0 * random.unit());
        let origin = centre + random.direction() * (distance * inner);
        let ray = ray(origin, target(triangles, &mut random) - origin);
        let to_centre =
            (centre.as_dvec3() - ray.origin.as_dvec3()).cross(ray.direction.as_dvec3().normalize()).length();
        if to_centre < 0.99 * f64::from(inner) {
            check(ray, "from far away");
            aimed += 1;
        }
    }
}

#[test]
fn no_leak_from_a_sphere() {
    check_closed("sphere", &sphere(58, 0.0), Vec3::ZERO, 0.99, |random| random.cube() * 0.5);
}

#[test]
fn no_leak_from_a_noisy_sphere() {
    check_closed("noisy sphere", &sphere(58, 0.1), Vec3::ZERO, 0.85, |random| random.cube() * 0.45);
}

#[test]
fn no_leak_from_a_room() {
    check_closed("room", &cuboid(1, Vec3::ONE), Vec3::ZERO, 1.0, |random| random.cube() * 0.999);
    check_closed("tiled room", &cuboid(16, Vec3::ONE), Vec3::ZERO, 1.0, |random| random.cube() * 0.999);
}

#[test]
fn no_leak_from_a_room_far_from_the_origin() {
    let turn = Mat3::from_rotation_x(0.3) * Mat3::from_rotation_y(1.1) * Mat3::from_rotation_z(0.7);
    let shift = Vec3::new(1000.0, -700.0, 500.0);
    let room = moved(cuboid(4, Vec3::ONE), turn, 1.0, shift);
    check_closed("room at 1000", &room, shift, 0.99, |random| turn * (random.cube() * 0.99) + shift);
}

#[test]
fn no_leak_from_thin_boxes() {
    for thickness in [1e-2, 1e-4, 1e-6] {
        let half = Vec3::new(1.0, thickness, 0.7);
        check_closed("thin box", &cuboid(2, half), Vec3::ZERO, 0.0, |random| random.cube() * 0.99 * half);
    }
}

#[test]
fn rays_along_axes_and_planes() {
    let triangles = cuboid(4, Vec3::ONE);
    let accels = every_kernel(&triangles);
    let steps = [-1.0f32, -0.75, -0.5, -0.25, -0.0, 0.0, 0.3, 0.5, 1.0];
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            for (i, j) in steps.iter().flat_map(|&i| steps.map(move |j| (i, j))) {
                let mut origin = Vec3::ZERO;
                origin[(axis + 1) % 3] = i;
                origin[(axis + 2) % 3] = j;
                let mut direction = Vec3::splat(0.0f32.copysign(i));
                direction[axis] = sign;
                // Through the walls' edges, corners and tiles, from within and from outside.
                for start in [0.0, -2.0, -0.5, 0.25] {
                    let mut ray = ray(origin, direction);
                    ray.origin[axis] = start * sign;
                    let (hit, hits) = ask(&accels, &ray);
                    let hit = hit.unwrap_or_else(|| panic!("lost {ray:?}"));
                    assert_eq!(hit.t, if start == -2.0 { 1.0 } else { 1.0 - start }, "{ray:?}");
                    assert_eq!(hits, brute_force(&triangles, &ray), "{ray:?}");
                }
                // Starting on a wall and leaving it.
                let mut ray = ray(origin, direction);
                ray.origin[axis] = -sign;
                assert_eq!(ask(&accels, &ray).0.map(|hit| hit.t), Some(2.0), "{ray:?}");
            }
        }
    }
}

#[test]
fn rays_that_are_not_finite_meet_nothing() {
    let accels = every_kernel(&furnished_room(3, 10));
    let odd = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN_POSITIVE, 1e-45, 0.0, -0.0, 1.0];
    for &a in &odd {
        for &b in &odd {
            for &c in &odd {
                for (origin, direction, t_max) in [
                    (Vec3::new(a, b, 0.1), Vec3::new(0.1, 0.2, c), f32::INFINITY),
                    (Vec3::new(0.1, 0.2, 0.3), Vec3::new(a, b, c), f32::INFINITY),
                    (Vec3::new(0.1, 0.2, a), Vec3::new(0.3, b, 0.4), c),
                    (Vec3::new(a, b, c), Vec3::new(c, a, b), b),
                ] {
                    let ray = Ray { origin, direction, t_max };
                    let (hit, _) = ask(&accels, &ray);
                    let usable = origin.is_finite() && direction.is_finite() && direction != Vec3::ZERO && t_max > 0.0;
                    assert!(usable || hit.is_none(), "{ray:?} met {hit:?}");
                }
            }
        }
    }
}

#[test]
fn no_self_hit_after_the_offset() {
    let mut random = Random::new(3);
    let mut rays = 0u32;
    while rays < 300_000 {
        // Triangles of 16 decades of sizes at 16 decades of distances, as in pbrt's Triangle.Reintersect.
        let spread = |random: &mut Random| random.cube() * 10f32.powf(8.0 * random.signed());
        let place = if random.index(2) == 0 { spread(&mut random) } else { Vec3::ZERO };
        let same_size = random.index(2) == 0;
        let size = 10f32.powf(8.0 * random.signed());
        let triangle: [Vec3; 3] =
            std::array::from_fn(|_| place + if same_size { random.cube() * size } else { spread(&mut random) });
        let [a, b, c] = triangle.map(Vec3::as_dvec3);
        let Some(normal) = (b - a).cross(c - a).try_normalize().map(|n| n.as_vec3()) else { continue };
        let accels = every_kernel(&[triangle]);
        let extent = triangle.iter().fold(0.0f32, |m, p| m.max(p.abs().max_element()));
        for _ in 0..64 {
            let (u, v) = (random.unit(), random.unit());
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let position = triangle[0] * (1.0 - u - v) + triangle[1] * u + triangle[2] * v;
            let side = normal * 1f32.copysign(random.signed());
            let origin = offset_origin(position, side, extent);
            // Any azimuth; cosines to the normal from 1 down to 1e-4.
            let cosine = 10f32.powf(-4.0 * random.unit());
            let across = random.direction().cross(side).normalize_or_zero();
            let direction = side * cosine + across * (1.0 - cosine * cosine).sqrt();
            if direction.dot(side) < 1e-4 {
                continue;
            }
            for accel in &accels {
                let hit = accel.closest(&ray(origin, direction));
                assert!(hit.is_none(), "{triangle:?} met again from {position:?} along {direction:?}: {hit:?}");
            }
            rays += 1;
        }
    }
}

#[test]
fn degenerate_triangles_build_and_trace() {
    let mut random = Random::new(4);
    let p = Vec3::new(0.1, 0.2, 0.3);
    let mut mixed = furnished_room(2, 10);
    let whole = mixed.len();
    mixed.extend([[p; 3], [p, p, Vec3::ONE], [Vec3::ZERO, p, p * 2.0], [Vec3::NAN; 3], [Vec3::INFINITY, p, p]]);
    let scenes = [
        vec![],
        vec![[p; 3]],
        vec![[Vec3::ZERO; 3]; 100],
        vec![[p, p + Vec3::X, p + Vec3::Y]; 1000],
        vec![[Vec3::ZERO, p, p * 2.0]; 50],
        vec![[Vec3::NAN; 3]; 10],
        vec![[Vec3::splat(f32::MAX), Vec3::splat(-f32::MAX), p]; 20],
        moved(cuboid(3, Vec3::ONE), Mat3::IDENTITY, 1e20, Vec3::ZERO),
        moved(cuboid(3, Vec3::ONE), Mat3::IDENTITY, 1e-30, Vec3::ZERO),
        mixed,
    ];
    for triangles in &scenes {
        let accels = every_kernel(triangles);
        for _ in 0..200 {
            ask(&accels, &ray(random.cube(), random.cube()));
        }
    }
    // Copies at one place: the lowest id answers, and each is visited once.
    let copies = every_kernel(&scenes[3]);
    let (hit, hits) = ask(&copies, &ray(p + Vec3::new(0.2, 0.2, 1.0), Vec3::NEG_Z));
    assert_eq!((hit.map(|h| h.triangle), hits.len()), (Some(0), 1000));
    // What is degenerate is never hit, nor in the way.
    let accels = every_kernel(&scenes[9]);
    for _ in 0..2000 {
        let (hit, _) = ask(&accels, &ray(random.cube() * 0.9, random.direction()));
        assert!(hit.is_some_and(|hit| (hit.triangle as usize) < whole));
    }
    // Huge and tiny rooms hold light like any other.
    for (scene, scale) in [(7, 1e20), (8, 1e-30)] {
        let accels = every_kernel(&scenes[scene]);
        for _ in 0..2000 {
            let (hit, _) = ask(&accels, &ray(random.cube() * (0.9 * scale), random.direction()));
            assert!(hit.is_some(), "lost at scale {scale}");
        }
    }
}
