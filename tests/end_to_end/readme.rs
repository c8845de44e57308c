//! The README, run word for word: the commands of its table by what one has, and the pipeline file for one's own frames.

use crate::hosts::Host;
use crate::programs::router;
use crate::support::{Playground, Started, TRACKING, signal, wait_until};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::Signal;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

const README: &str = include_str!("../../README.md");
const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// The commands that the table has for who has this.
fn commands(has: &str) -> Vec<&'static str> {
    let row = README.lines().find(|line| line.starts_with(&format!("| {has}")));
    let cell = row.unwrap_or_else(|| panic!("no row for {has}")).split(" | ").nth(1).unwrap();
    let commands: Vec<_> = cell.split('`').skip(1).step_by(2).collect();
    assert!(!commands.is_empty(), "{cell}");
    commands
}

/// The command as a shell runs it that finds the program on its path.
fn shell(playground: &Playground, command: &str) -> Command {
    let mut shell = playground.command_of(Path::new("sh"), &["-c", &format!("exec {command}")]);
    let program = Path::new(env!("CARGO_BIN_EXE_conicflow")).parent().unwrap();
    let folders = [playground.path("."), program.to_owned()].map(|folder| folder.display().to_string());
    shell.env("PATH", format!("{}:{}", folders.join(":"), std::env::var("PATH").unwrap()));
    shell
}

/// A camera of ten frames of a table, as files.
fn frames() -> Playground {
    let playground = Playground::new();
    let camera = playground.record(Scene::built_in("tabletop").unwrap().unwrap(), 5, 10);
    let json = serde_json::json!({
        "width": camera.width, "height": camera.height,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
    });
    playground.write("frames/camera.json", &json.to_string());
    playground
}

#[test]
fn who_has_pngs_finds_objects_and_pictures_of_them() {
    let playground = frames();
    let [command] = commands("PNGs")[..] else { panic!("one command") };
    let ended = Started::new(shell(&playground, command)).wait().expect_code(0);
    let lines: Vec<serde_json::Value> = ended.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 10);
    assert!(lines.iter().all(|line| !line["objects"].as_array().unwrap().is_empty()), "{}", ended.stdout);
    assert_eq!(fs::read_dir(playground.path("pictures")).unwrap().count(), 10);
}

#[test]
fn the_pipeline_file_for_frames_of_ones_own_gives_a_line_for_each() {
    let playground = frames();
    let text = README.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    playground.write("pipeline.toml", text);
    playground.conicflow(&["run"]).expect_code(0);
    let lines = playground.json_lines("tracks.jsonl");
    assert_eq!(lines.len(), 10);
    assert!(!lines[9]["tracks"].as_array().unwrap().is_empty(), "{}", lines[9]);
}

#[test]
fn who_has_a_recording_finds_the_objects_in_it() {
    let sink = "node = \"mcap_sink\"\ninput = { topic = \"depth\", delivery = \"lossless\" }\npath = \"run.mcap\"\n";
    let playground = Playground::with_pipeline(&format!("{TRACKING}\n[stage.recorder]\n{sink}"));
    playground.conicflow(&["run", "--frames", "12"]).expect_code(0);
    let [command] = commands("a ROS 2 recording")[..] else { panic!("one command") };
    let ended = Started::new(shell(&playground, command)).wait().expect_code(0);
    assert_eq!(ended.stdout.lines().count(), 12, "{}", ended.stderr);
}

/// The address in the command is that of a host without any other, which has a router.
#[test]
fn who_has_a_robot_with_ros_reaches_its_router() {
    let Some(host) = Host::new() else { return };
    host.ip("addr add 192.168.0.2/32 dev lo");
    let playground = Playground::new();
    let _router = host.start(&router(&["tcp/192.168.0.2:7447".to_owned()]));
    let [command] = commands("a robot with ROS 2")[..] else { panic!("one command") };
    let mut shell = shell(&playground, command);
    let mut run = host.start(shell.current_dir(ROOT));
    run.wait_for_text("nobody publishes `/camera/depth/image_rect_raw`");
    wait_until("the sink has joined", || playground.top()["stages"].as_array().is_some_and(|stages| stages.len() == 5));
    signal(run.id(), Signal::INT);
    run.wait().expect_code(0);
}

/// Both machines are one host, in runtime folders of their own, as the file stands.
#[test]
fn who_has_two_machines_runs_the_halves_of_a_pipeline() {
    let Some(host) = Host::new() else { return };
    let [robot, base] = commands("two machines")[..] else { panic!("two commands") };
    let runs = [robot, base].map(|command| {
        let playground = Playground::new();
        let mut shell = shell(&playground, command);
        (host.start(shell.current_dir(ROOT)), playground)
    });
    let [robot, base] = runs.map(|(run, _playground)| run.wait().expect_code(0));
    assert!(robot.stderr.contains("ellipses"), "{}", robot.stderr);
    assert!(base.stdout.lines().count() > 5, "{}", base.stdout);
}

/// With a Python that has neither the package nor the SDK; where both are, the tests of the Python package run this.
#[test]
fn who_has_a_camera_is_told_what_is_missing() {
    let playground = Playground::new();
    playground.write("python3", "#!/bin/sh\necho 'No module named conicflow' >&2\nexit 1\n");
    fs::set_permissions(playground.path("python3"), fs::Permissions::from_mode(0o755)).unwrap();
    let [command] = commands("a camera")[..] else { panic!("one command") };
    let mut shell = shell(&playground, command);
    shell.current_dir(ROOT).env_remove("VIRTUAL_ENV");
    let ended = Started::new(shell).wait().expect_code(2);
    assert!(ended.stderr.contains("-m pip install \"./python[realsense]\"`"), "{}", ended.stderr);
}
