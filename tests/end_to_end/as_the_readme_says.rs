//! Runs the commands of the README as they are written: those of its table by what a user has, and the pipeline file for a user's
//! own frames. Programs are built without optimisation, in the target folder of the tests. Tests start in the order of their
//! names, and this module's name puts its tests, which take longest, first.

use crate::bridge::link;
use crate::hosts::Host;
use crate::outside_stage::ball_before_a_wall;
use crate::programs::router;
use crate::support::{Playground, Started, TRACKING, copy_program, wait_until};
use conicflow_lab::simulator::scene::Scene;
use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Settings that make a release build fast if it is only tried out.
const QUICK: [(&str, &str); 2] = [("CARGO_PROFILE_RELEASE_LTO", "off"), ("CARGO_PROFILE_RELEASE_OPT_LEVEL", "0")];

const README: &str = include_str!("../../README.md");
const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// The commands of the table's row for users who have this.
fn commands(has: &str) -> Vec<&'static str> {
    let row = README.lines().find(|line| line.starts_with(&format!("| {has}")));
    let cell = row.unwrap_or_else(|| panic!("no row for {has}")).split(" | ").nth(1).unwrap();
    let commands: Vec<_> = cell.split('`').skip(1).step_by(2).collect();
    assert!(!commands.is_empty(), "{cell}");
    commands
}

/// The command in a shell that finds the program on its path.
fn shell(playground: &Playground, command: &str) -> Command {
    let mut shell = playground.command_of(Path::new("sh"), &["-c", &format!("exec {command}")]);
    let program = Path::new(env!("CARGO_BIN_EXE_conicflow")).parent().unwrap();
    let folders = [playground.path("."), program.to_owned()].map(|folder| folder.display().to_string());
    shell.env("PATH", format!("{}:{}", folders.join(":"), std::env::var("PATH").unwrap()));
    shell
}

/// A playground with ten frames of a table and their camera, as files.
fn frames() -> Playground {
    let playground = Playground::new();
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, 10);
    playground
}

#[test]
fn a_user_with_pngs_gets_objects_and_pictures_of_them() {
    let playground = frames();
    let [command] = commands("PNGs")[..] else { panic!("one command") };
    let ended = Started::new(shell(&playground, command)).wait().expect_code(0);
    let lines: Vec<serde_json::Value> = ended.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 10);
    assert!(lines.iter().all(|line| !line["objects"].as_array().unwrap().is_empty()), "{}", ended.stdout);
    assert_eq!(fs::read_dir(playground.path("pictures")).unwrap().count(), 10);
}

#[test]
fn the_pipeline_file_for_the_users_frames_gives_a_line_for_each() {
    let playground = frames();
    let text = README.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    playground.write("pipeline.toml", text);
    playground.conicflow(&["run"]).expect_code(0);
    let lines = playground.json_lines("tracks.jsonl");
    assert_eq!(lines.len(), 10);
    assert!(!lines[9]["tracks"].as_array().unwrap().is_empty(), "{}", lines[9]);
}

#[test]
fn a_user_with_a_recording_gets_the_objects_in_it() {
    let sink = "node = \"mcap_sink\"\ninput = { topic = \"depth\", delivery = \"lossless\" }\npath = \"run.mcap\"\n";
    let playground = Playground::with_pipeline(&format!("{TRACKING}\n[stage.recorder]\n{sink}"));
    playground.conicflow(&["run", "--frames", "12"]).expect_code(0);
    let [command] = commands("a ROS 2 recording")[..] else { panic!("one command") };
    let ended = Started::new(shell(&playground, command)).wait().expect_code(0);
    assert_eq!(ended.stdout.lines().count(), 12, "{}", ended.stderr);
}

/// The address in the command is that of a host with a router, which no test may reach. Here the router runs in another network
/// namespace.
#[test]
fn a_user_with_a_ros_robot_reaches_its_router() {
    let Some(host) = Host::new() else { return };
    host.ip("addr add 192.168.0.2/32 dev lo");
    let playground = Playground::new();
    let _router = host.start(&router(&["tcp/192.168.0.2:7447".to_owned()]));
    let [command] = commands("a robot with ROS 2")[..] else { panic!("one command") };
    let mut shell = shell(&playground, command);
    let mut run = host.start(shell.current_dir(ROOT));
    run.wait_for_text("nobody publishes `/camera/depth/image_rect_raw`");
    wait_until("the sink has joined", || playground.top()["stages"].as_array().is_some_and(|stages| stages.len() == 5));
    run.end();
}

/// Both machines are this host, each with its own runtime folder. The pipeline file is that of the repository, but the run is
/// shorter.
#[test]
fn a_user_with_two_machines_runs_the_halves_of_a_pipeline() {
    let Some(host) = Host::new() else { return };
    let [robot, base] = commands("two machines")[..] else { panic!("two commands") };
    let runs = [(robot, "--frames 60"), (base, "--set console.period_s=0.1")].map(|(command, shorter)| {
        let playground = Playground::new();
        let mut shell = shell(&playground, &format!("{command} {shorter}"));
        (host.start(shell.current_dir(ROOT)), playground)
    });
    let [robot, base] = runs.map(|(run, _playground)| run.wait().expect_code(0));
    let [sent, lost, _] = link(&robot, "base", "ellipses");
    assert!(sent > 30 && lost == 0, "{}", robot.stderr);
    assert!(base.stdout.lines().count() > 5, "{}", base.stdout);
}

/// For a Python that has neither the package nor the SDK. With both, the tests of the Python package cover this command.
#[test]
fn a_user_with_a_camera_reads_what_is_missing() {
    let playground = Playground::new();
    playground.write("program", "#!/bin/sh\necho 'No module named conicflow' >&2\nexit 1\n");
    fs::set_permissions(playground.path("program"), fs::Permissions::from_mode(0o755)).unwrap();
    copy_program(&playground.path("program"), &playground.path("python3"));
    let [command] = commands("a camera")[..] else { panic!("one command") };
    let mut shell = shell(&playground, command);
    shell.current_dir(ROOT).env_remove("VIRTUAL_ENV");
    let ended = Started::new(shell).wait().expect_code(2);
    // The command depends on whether the package is built from this checkout or installed from the Debian package.
    let commands = ["-m pip install \"./python[realsense]\"`", "sudo /opt/conicflow/bin/pip install pyrealsense2`"];
    assert!(commands.iter().any(|command| ended.stderr.contains(command)), "{}", ended.stderr);
}

/// Returns whether these programs are installed; otherwise prints that the test is skipped, and why.
fn has(programs: &[&str], what: &str) -> bool {
    let is_there =
        |program: &&&str| Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success());
    let missing: Vec<_> = programs.iter().filter(|program| !is_there(program)).collect();
    if !missing.is_empty() {
        eprintln!("SKIPPED: {missing:?} cannot be run here; {what} was not shown");
    }
    missing.is_empty()
}

/// A copy of the sources in a folder that stays, so that a later run of the tests builds only what has changed.
fn checkout() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("checkout");
    fs::create_dir_all(&folder).unwrap();
    for name in fs::read_dir(ROOT).unwrap().map(|entry| entry.unwrap().file_name()).filter(|name| name != "target") {
        fs::remove_file(folder.join(&name)).ok();
        symlink(Path::new(ROOT).join(&name), folder.join(&name)).unwrap();
    }
    folder
}

/// Runs a shell script in a folder, and asserts that it succeeds.
fn done(script: &str, folder: &Path) -> Output {
    let mut shell = Command::new("sh");
    shell.args(["-ec", script]).current_dir(folder).env_remove("CARGO_TARGET_DIR").envs(QUICK);
    let output = shell.output().unwrap();
    assert!(output.status.success(), "{script}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

#[test]
fn a_user_with_a_program_in_c_gets_objects_from_the_library() {
    if !has(&["cc"], "that a program in C is built as the document says") {
        return;
    }
    let folder = checkout();
    let pixels = ball_before_a_wall(640, 480, 525.0).into_iter().flat_map(u16::to_be_bytes);
    fs::write(
        folder.join("frame.pgm"),
        b"P5\n# as GIMP writes it\n640 480\n65535\n".iter().copied().chain(pixels).collect::<Vec<_>>(),
    )
    .unwrap();
    let [command] = commands("a program in C")[..] else { panic!("one command") };
    let block = include_str!("../../docs/c.md").split("```console\n").nth(1).unwrap().split("```").next().unwrap();
    let lines: Vec<_> = block.lines().filter_map(|line| line.strip_prefix("$ ")).collect();
    assert!(lines.len() == 3 && lines[0].starts_with(command), "{block}");
    let output = String::from_utf8(done(&lines.join("\n"), &folder).stdout).unwrap();
    assert!(output.starts_with("sphere at (") && output.contains(" 1.000) m, radius 0.1500 m +- "), "{output}");
}

/// Creates the virtual environment `venv`, and installs what the package needs. pip and NumPy are those of PYTHON if it has them:
/// to unpack both takes longer than to build the package.
const READY: &str = r#"
if there=$(PYTHON -c 'import numpy, pip; print(*numpy.__path__, *pip.__path__)'); then
    PYTHON -m venv --without-pip venv
    for package in $there; do ln -s "$package"* venv/lib/python3*/site-packages/; done
    printf '#!/bin/sh\nexec python -m pip "$@"\n' >venv/bin/pip
    chmod +x venv/bin/pip
else
    PYTHON -m venv venv
    pip install --quiet --timeout 20 --retries 1 numpy || exit 7
fi
pip download --quiet --timeout 20 --retries 1 --no-deps --dest wheels 'maturin>=1.9,<2' || exit 7
"#;

/// Exit code of [`READY`] if pip cannot install what the package needs.
const NOT_INSTALLED: i32 = 7;

#[test]
fn a_user_with_python_installs_the_package_and_finds_objects() {
    let (playground, what) = (frames(), "that `pip install ./python` works");
    let python = std::env::var("CONICFLOW_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !has(&[&python], what) {
        return;
    }
    let folders = format!("{}:{}", playground.path("venv/bin").display(), std::env::var("PATH").unwrap());
    let wheels = playground.path("wheels");
    // The build of the tests has left a part of the package's dependencies there.
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let run = |script: &str, folder: &Path| {
        let mut shell = Command::new("sh");
        shell
            .args(["-ec", script])
            .current_dir(folder)
            .env("PATH", &folders)
            .env("CARGO_TARGET_DIR", target)
            .env("MATURIN_PEP517_ARGS", "--profile dev")
            .env("PIP_FIND_LINKS", &wheels);
        shell.output().unwrap()
    };
    let ready = run(&READY.replace("PYTHON", &python), &playground.path("."));
    if ready.status.code() == Some(NOT_INSTALLED) {
        eprintln!("SKIPPED: maturin and numpy cannot be installed here; {what} was not shown");
        return;
    }
    assert!(ready.status.success(), "{}", String::from_utf8_lossy(&ready.stderr));
    let [command, ..] = commands("Python")[..] else { panic!("a command") };
    let installed = run(command, Path::new(ROOT));
    assert!(installed.status.success(), "{}", String::from_utf8_lossy(&installed.stderr));
    let pixels = ball_before_a_wall(640, 480, 525.0).into_iter().flat_map(u16::to_le_bytes).collect::<Vec<_>>();
    fs::write(playground.path("depth.u16"), pixels).unwrap();
    let document = include_str!("../../docs/python.md").split("## Find objects").nth(1).unwrap();
    let block = document.split("```python\n").nth(1).unwrap().split("```").next().unwrap();
    let before = "import numpy\ndepth = numpy.fromfile(\"depth.u16\", \"<u2\").reshape(480, 640)\n\
                  fx, fy, cx, cy = 525, 525, 319.5, 239.5\n";
    playground.write("found.py", &format!("{before}{block}"));
    let found = run("python found.py", &playground.path("."));
    let output = String::from_utf8_lossy(&found.stdout);
    assert!(
        output.starts_with("sphere [") && output.contains("0.15"),
        "{output}{}",
        String::from_utf8_lossy(&found.stderr)
    );
}

#[test]
fn a_user_with_python_reads_the_lines_of_json() {
    if !has(&["python3"], "that a program in Python reads lines of JSON") {
        return;
    }
    let playground = frames();
    playground
        .write("your.py", "import json, sys\nprint(sum(len(json.loads(line)[\"objects\"]) for line in sys.stdin))\n");
    let command = README.split("lines of JSON: `").nth(1).unwrap().split('`').next().unwrap().replace("\\|", "|");
    let ended = Started::new(shell(&playground, &command)).wait().expect_code(0);
    assert!(ended.stdout.trim().parse::<u32>().unwrap() > 10, "{}", ended.stdout);
}

/// The package is unpacked and not installed, so that it does not change this machine.
#[test]
fn a_user_with_a_robot_builds_a_debian_package() {
    let what = "that the package for Debian and Ubuntu is made and works";
    if !has(&["cargo-deb", "cargo-about", "dpkg-deb"], what) {
        return;
    }
    let [command, ..] = commands("a robot to run it on")[..] else { panic!("a command") };
    let output = String::from_utf8(done(command, &checkout()).stdout).unwrap();
    let playground = Playground::with_pipeline(TRACKING);
    done(&format!("dpkg-deb -x {} root", output.lines().last().unwrap()), &playground.path("."));
    let program = playground.path("root/usr/bin/conicflow");
    Started::new(playground.command_of(&program, &["run", "--frames", "12"])).wait().expect_code(0);
    assert_eq!(playground.lines("tracks.jsonl").len(), 12);
    let package = playground.path("root/usr/lib/python3/dist-packages/conicflow");
    for file in ["__init__.py", "_conicflow.abi3.so", "cameras/realsense.py", "py.typed"] {
        assert!(package.join(file).is_file(), "{file}");
    }
    for file in ["usr/include/conicflow.h", "usr/share/conicflow/pipeline.schema.json"] {
        assert!(playground.path("root").join(file).is_file(), "{file}");
    }
}
