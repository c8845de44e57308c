//! What others may send to a bridge: garbage, or messages of another version.

use super::bridge::{self, apart, loopback, machines, newest, start};
use super::support::{Playground, signal, wait_until};
use conicflow_bridge::WIRE_VERSION;
use rustix::process::Signal;
use zenoh::Wait;

/// A Zenoh session of somebody who connects to an endpoint.
fn intruder(endpoint: &str) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("scouting/multicast/enabled", "false"),
        ("listen/endpoints", "[]"),
        ("connect/endpoints", &format!("[\"{endpoint}\"]")),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// Both machines where the base listens and the newest wins.
fn live(endpoint: &str) -> [Playground; 2] {
    let text = bridge::live(&apart(endpoint, endpoint));
    let text = text.replace("listen = [", "@").replace("connect = [", "listen = [").replace('@', "connect = [");
    machines(&text)
}

#[test]
fn a_flood_of_garbage_is_counted_and_does_no_harm() {
    let endpoint = loopback();
    let [robot, base] = live(&endpoint);
    let (robot_run, mut base_run) = (start(&robot, "robot"), start(&base, "base"));
    base_run.wait_until("tracks arrive", || newest(&base) > 20);
    let session = intruder(&endpoint);
    let before = newest(&base);
    let mut noise = 0x9e37_79b9_u32;
    base_run.wait_until("tracks go on in the flood", || {
        for length in [0, 3, 40, 700, 70_000] {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let garbage: Vec<u8> = (0..length).map(|index| (noise >> (index % 24)) as u8).collect();
            let prefixed = [b"CFLO".as_slice(), &WIRE_VERSION.to_le_bytes(), &garbage].concat();
            for key in ["robot/ellipses", "@link/robot"] {
                session.put(format!("conicflow/tracking/{key}"), garbage.clone()).wait().unwrap();
                session.put(format!("conicflow/tracking/{key}"), prefixed.clone()).wait().unwrap();
            }
        }
        newest(&base) > before + 60
    });
    assert!(base_run.stderr().contains("left out a message of topic `ellipses` from machine `robot`"));
    signal(robot_run.id(), Signal::INT);
    robot_run.wait().expect_code(0);
    let ended = base_run.wait().expect_code(0);
    assert_eq!(ended.stage("bridge").starts, 1, "{}", ended.stderr);
}

#[test]
fn a_machine_of_another_version_is_refused_by_name_and_numbers() {
    let endpoint = loopback();
    let [_, base] = live(&endpoint);
    let mut base_run = start(&base, "base");
    base_run.wait_until("its port is open", || std::net::TcpStream::connect(&endpoint[4..]).is_ok());
    let session = intruder(&endpoint);
    let expected =
        format!("refused machine `robot`: the other machine speaks version 99 of the wire, this one {WIRE_VERSION}");
    wait_until("it is refused", || {
        session.put("conicflow/tracking/@link/robot", b"CFLO\x63\x00".as_slice()).wait().unwrap();
        base_run.stderr().contains(&expected)
    });
    signal(base_run.id(), Signal::INT);
    base_run.wait().expect_code(0);
}

#[test]
fn a_machine_with_another_pipeline_file_is_told_what_differs() {
    let endpoint = loopback();
    let [robot, base] = live(&endpoint);
    let mut base_run = start(&base, "base");
    let sets = ["--set", "assembler.machine=robot"];
    let mut robot_run = robot.start(&[&["run", "--machine", "robot"][..], &sets].concat());
    base_run.wait_for_text("machine `robot` has another pipeline file; what crosses here: topic `ellipses`");
    robot_run.wait_for_text("machine `base` has another pipeline file; what crosses here: topic `objects`");
    for run in [base_run, robot_run] {
        signal(run.id(), Signal::INT);
        run.wait().expect_code(0);
    }
}
