//! Tests of the library from C: the header and the example are compiled with `cc`, linked statically and dynamically, and run;
//! their results equal those of the Rust library bit for bit.

#![allow(missing_docs)] // the names of tests are their documentation
#![allow(clippy::unwrap_used)] // in tests, a panic is a failure

use conicflow_detection::{Camera, Detector, NoiseModel, Object};
use conicflow_geometry::Vector3;
use conicflow_lab::rendered::{KINECT_HALF, frustum, plane, render, sphere};
use std::mem::offset_of;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;

/// The name by which programs find the shared library.
const SHARED_NAME: &str =
    concat!("libconicflow.so.", env!("CARGO_PKG_VERSION_MAJOR"), ".", env!("CARGO_PKG_VERSION_MINOR"));

/// Returns the compiler, or `None` with a message if there is none.
fn compiler() -> Option<&'static str> {
    let found = Command::new("cc").arg("--version").output().is_ok_and(|output| output.status.success());
    if !found {
        eprintln!("SKIPPED: there is no C compiler `cc`; nothing was shown");
    }
    found.then_some("cc")
}

fn folder() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the path of a library that cargo has built beside this test.
fn library(name: &str) -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let beside = tests.parent().unwrap().join(name);
    if beside.is_file() { beside } else { tests.parent().unwrap().with_file_name(name) }
}

/// Compiles a program and links it with the static or the shared library. After linking, only the versioned name of the shared
/// library remains, as where only the runtime package is installed.
fn compile(source: &Path, into: &TempDir, shared: bool) -> Option<PathBuf> {
    let program = into.path().join(source.file_stem().unwrap());
    let mut command = Command::new(compiler()?);
    command.args(["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I"]).arg(folder()).arg(source);
    let linked = into.path().join("libconicflow.so");
    if shared {
        let built = library("libconicflow.so");
        symlink(&built, into.path().join(SHARED_NAME)).unwrap();
        symlink(&built, &linked).unwrap();
        let folder = into.path().display();
        command.args([format!("-L{folder}"), "-lconicflow".to_owned(), format!("-Wl,-rpath,{folder}")]);
    } else {
        command.arg(library("libconicflow.a"));
    }
    command.args(["-lm", "-lpthread", "-ldl", "-lgcc_s", "-o"]).arg(&program);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    if shared {
        std::fs::remove_file(linked).unwrap();
    }
    Some(program)
}

fn run(program: &Path, arguments: &[String]) -> Output {
    Command::new(program).args(arguments).output().unwrap()
}

/// A ball, a can and a cone in front of a wall.
fn scene() -> (Camera, Vec<u16>) {
    let frustum = |x: f64, slope: f64| frustum(Vector3::new(x, 0.1, 1.4), Vector3::y(), 0.1, slope, 0.4);
    let ball = sphere(Vector3::new(0.0, 0.0, 1.2), 0.12);
    let wall = plane(Vector3::z(), 2.5);
    let (header, pixels) =
        render(KINECT_HALF, NoiseModel::KINECT_V1, &[ball, frustum(0.45, 0.0), frustum(-0.45, 0.3), wall], 3);
    let millimetres = pixels.iter().map(|&z| (f64::from(z) * header.depth_scale * 1e3).round() as u16);
    (header.camera, millimetres.collect())
}

#[test]
fn the_example_prints_what_the_rust_library_finds() {
    let files = TempDir::new().unwrap();
    let Some(program) = compile(&folder().join("example.c"), &files, false) else { return };
    let (camera, depth) = scene();
    let path = files.path().join("frame.pgm");
    let mut pgm = format!("P5 {} {} 65535\n", camera.width, camera.height).into_bytes();
    pgm.extend(depth.iter().flat_map(|pixel| pixel.to_be_bytes()));
    std::fs::write(&path, &pgm).unwrap();
    let numbers = [camera.fx, camera.fy, camera.cx, camera.cy].map(|number| number.to_string());
    let arguments = [&[path.to_str().unwrap().to_owned()], &numbers[..]].concat();
    let output = run(&program, &arguments);
    let objects = Detector::new(camera).noise(NoiseModel::KINECT_V1).depth_scale(0.001).detect(&depth);
    let expected = objects.iter().map(|o| {
        let ([x, y, z], deviation) = (o.center, o.sigma.center[2][2].sqrt());
        format!(
            "{} at ({x:.3}, {y:.3}, {z:.3}) m, radius {:.4} m +- {:.4}, depth +- {deviation:.4}, confidence {:.2}\n",
            o.shape().name(),
            o.radius,
            o.sigma.radius,
            o.confidence,
        )
    });
    assert_eq!(String::from_utf8(output.stdout).unwrap(), expected.collect::<String>());
    let mut kinds: Vec<_> = objects.iter().map(|object| object.shape().name()).collect();
    kinds.sort_unstable();
    assert_eq!((output.status.code(), kinds), (Some(0), vec!["cone", "cylinder", "sphere"]));
    std::fs::write(&path, &pgm[..1000]).unwrap();
    let cut = run(&program, &arguments);
    assert_eq!((cut.status.code(), cut.stdout.len()), (Some(1), 0));
}

/// Returns the bytes that the C program writes for the objects in an image with rows at distances of `row_bytes`.
fn all_numbers<T: bytemuck::NoUninit>(
    program: &Path,
    camera: Camera,
    pixels: &[T],
    row_bytes: usize,
    scale: f64,
    noise: &str,
) -> Vec<u8> {
    let file = program.with_file_name("pixels");
    std::fs::write(&file, bytemuck::cast_slice(pixels)).unwrap();
    let Camera { width, height, fx, fy, cx, cy } = camera;
    let kind = if size_of::<T>() == 2 { "u16" } else { "f32" };
    let arguments =
        format!("{kind} {} {width} {height} {fx} {fy} {cx} {cy} {row_bytes} {scale} {noise}", file.display());
    let output = run(program, &arguments.split(' ').map(str::to_owned).collect::<Vec<_>>());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// Adds `gap` pixels after each row, which would show in the results if they were read as depths.
fn with_gaps<T: Copy>(pixels: &[T], columns: usize, gap: usize, filler: T) -> Vec<T> {
    pixels.chunks(columns).flat_map(|row| row.iter().copied().chain(std::iter::repeat_n(filler, gap))).collect()
}

#[test]
fn every_number_is_that_of_the_rust_library_to_the_bit() {
    let (camera, depth) = scene();
    let metres: Vec<f32> = depth.iter().map(|&z| if z == 0 { f32::NAN } else { f32::from(z) * 0.001 }).collect();
    let detector = |scale: f64, noise: NoiseModel| Detector::new(camera).noise(noise).depth_scale(scale);
    // For the second image, the detector has learned from the first.
    let twice = |mut detector: Detector, detect: &dyn Fn(&mut Detector) -> Vec<Object>| {
        let objects = [detect(&mut detector), detect(&mut detector)].concat();
        bytemuck::cast_slice::<_, u8>(&objects).to_vec()
    };
    for shared in [false, true] {
        let files = TempDir::new().unwrap();
        let Some(program) = compile(&folder().join("tests/all_numbers.c"), &files, shared) else { return };
        let columns = camera.width as usize;
        let (gaps, metres_gaps) = (with_gaps(&depth, columns, 7, 900), with_gaps(&metres, columns, 3, 0.9));
        let expected = twice(detector(0.001, NoiseModel::KINECT_V1), &|each| each.detect(&depth));
        assert!(expected.len() >= 6 * size_of::<Object>());
        let of =
            |pixels: &[u16], row_bytes, scale, noise| all_numbers(&program, camera, pixels, row_bytes, scale, noise);
        assert!(
            of(&depth, 0, 0.001, "kinect_v1") == expected
                && of(&gaps, 2 * (columns + 7), 0.001, "kinect_v1") == expected
        );
        // Another scale and another sensor give other numbers, which again equal those of the Rust library.
        let other = twice(detector(0.0012, NoiseModel::IDEAL), &|each| each.detect(&depth));
        assert!(other != expected && of(&depth, 2 * columns, 0.0012, "ideal") == other);
        let expected = twice(detector(0.001, NoiseModel::KINECT_V1), &|each| each.detect_f32(&metres));
        let of = |pixels: &[f32], row_bytes| all_numbers(&program, camera, pixels, row_bytes, 0.001, "kinect_v1");
        assert!(of(&metres, 0) == expected && of(&metres_gaps, 4 * (columns + 3)) == expected && !expected.is_empty());
    }
}

#[test]
fn what_is_wrong_is_told_with_a_hint() {
    let files = TempDir::new().unwrap();
    let Some(program) = compile(&folder().join("tests/faults.c"), &files, true) else { return };
    let output = run(&program, &[]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8(output.stdout).unwrap(), include_str!("faults.txt"));
}

#[test]
fn the_versions_of_header_library_and_package_are_the_same() {
    let version = env!("CARGO_PKG_VERSION");
    let package = std::fs::read_to_string(folder().join("conicflow.pc")).unwrap();
    assert!(package.contains(&format!("\nVersion: {version}\n")), "{package}");
    let files = TempDir::new().unwrap();
    let Some(program) = compile(&folder().join("tests/version.c"), &files, true) else { return };
    let output = run(&program, &[]);
    assert_eq!(String::from_utf8(output.stdout).unwrap(), format!("{version} {version}\n"));
}

/// Compares the offsets of the structs' fields in C and in Rust.
#[test]
fn the_header_has_the_layouts_of_the_library() {
    let Some(compiler) = compiler() else { return };
    let files = TempDir::new().unwrap();
    let mut source = "#include \"conicflow.h\"\n".to_owned();
    let mut is = |what: String, number: usize| source += &format!("_Static_assert({what} == {number}, \"{what}\");\n");
    is("sizeof(conicflow_camera)".into(), size_of::<Camera>());
    is("sizeof(conicflow_object)".into(), size_of::<Object>());
    macro_rules! fields {
        ($c:literal, $rust:ty, $($field:ident),+) => {
            $(is(format!("offsetof({}, {})", $c, stringify!($field)), offset_of!($rust, $field));)+
        };
    }
    fields!("conicflow_camera", Camera, width, height, fx, fy, cx, cy);
    fields!("conicflow_object", Object, kind, points, rows, confidence, center, axis, radius, length, half_angle);
    fields!("conicflow_object", Object, base_radius, top_radius, apex, sigma, rms, arc);
    is("offsetof(conicflow_object, sigma.center_covariance)".into(), offset_of!(Object, sigma.center));
    is("offsetof(conicflow_object, sigma.axis)".into(), offset_of!(Object, sigma.axis));
    is("offsetof(conicflow_object, sigma.radius)".into(), offset_of!(Object, sigma.radius));
    is("offsetof(conicflow_object, sigma.length)".into(), offset_of!(Object, sigma.length));
    is("offsetof(conicflow_object, sigma.half_angle)".into(), offset_of!(Object, sigma.half_angle));
    for (extension, language) in [("c", "-std=c11"), ("cc", "-std=c++11")] {
        let file = files.path().join(format!("layout.{extension}"));
        std::fs::write(
            &file,
            source.replace("_Static_assert", if extension == "c" { "_Static_assert" } else { "static_assert" }),
        )
        .unwrap();
        let mut command = Command::new(compiler);
        let output = command
            .args([language, "-Wall", "-Werror", "-fsyntax-only", "-I"])
            .arg(folder())
            .arg(file)
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        if extension == "cc" && told.contains("cc1plus") {
            eprintln!("SKIPPED: this `cc` knows no C++; the header is not shown to be C++, too");
        } else {
            assert!(output.status.success(), "{told}");
        }
    }
}
