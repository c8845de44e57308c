//! Messages of intruders to a bridge: garbage, messages of another version, forged messages, and genuine ones that are sent
//! again.

use super::bridge::{self, apart, kill, loopback, machines, newest, start, top_link, wait_for_frames, wait_for_link};
use super::routers::session;
use super::support::{Playground, Started, signal, wait_until};
use conicflow_bridge::WIRE_VERSION;
use rustix::process::Signal;
use std::os::unix::fs::PermissionsExt;
use zenoh::Wait;

/// A Zenoh session that connects to these endpoints.
fn intruder(endpoints: &[&str]) -> zenoh::Session {
    session("peer", &[("connect/endpoints", &format!("{endpoints:?}"))])
}

/// Both machines with a live pipeline; the base listens.
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
    let session = intruder(&[&endpoint]);
    let mut noise = 0x9e37_79b9_u32;
    let mut flood = || {
        for length in [0, 3, 40, 700, 70_000] {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let garbage: Vec<u8> = (0..length).map(|index| (noise >> (index % 24)) as u8).collect();
            let prefixed = [b"CFLO".as_slice(), &WIRE_VERSION.to_le_bytes(), &garbage].concat();
            for key in ["robot/ellipses", "@link/robot"] {
                session.put(format!("conicflow/tracking/{key}"), garbage.clone()).wait().unwrap();
                session.put(format!("conicflow/tracking/{key}"), prefixed.clone()).wait().unwrap();
            }
        }
    };
    wait_until("the flood is refused", || {
        flood();
        base_run.stderr().contains("left out a message of topic `ellipses` from machine `robot`")
    });
    let before = newest(&base);
    base_run.wait_until("tracks go on in the flood", || {
        flood();
        newest(&base) > before + 30
    });
    robot_run.end();
    let ended = base_run.wait().expect_code(0);
    assert_eq!(ended.stage("bridge").starts, 1, "{}", ended.stderr);
}

#[test]
fn a_machine_of_another_version_is_refused_by_name_and_numbers() {
    let endpoint = loopback();
    let [_, base] = live(&endpoint);
    let mut base_run = start(&base, "base");
    base_run.wait_until("its port is open", || std::net::TcpStream::connect(&endpoint[4..]).is_ok());
    let session = intruder(&[&endpoint]);
    let expected =
        format!("refused machine `robot`: the other machine speaks version 99 of the wire, this one {WIRE_VERSION}");
    wait_until("it is refused", || {
        session.put("conicflow/tracking/@link/robot", b"CFLO\x63\x00".as_slice()).wait().unwrap();
        base_run.stderr().contains(&expected)
    });
    base_run.end();
}

#[test]
fn the_report_of_another_pipeline_file_says_what_differs() {
    let endpoint = loopback();
    let [robot, base] = live(&endpoint);
    let mut base_run = start(&base, "base");
    let sets = ["--set", "assembler.machine=robot"];
    let mut robot_run = robot.start(&[&["run", "--machine", "robot"][..], &sets].concat());
    base_run.wait_for_text("machine `robot` has another pipeline file; what crosses here: topic `ellipses`");
    robot_run.wait_for_text("machine `base` has another pipeline file; what crosses here: topic `objects`");
    drop([base_run, robot_run].map(Started::end));
}

/// Both machines of a live pipeline, both of which listen, and a session that is connected to both.
fn both_listening() -> ([Playground; 2], zenoh::Session, [Started; 2]) {
    let (robot, base) = (loopback(), loopback());
    let listening = format!("[machine.base]\nlisten = [\"{base}\"]\n");
    let machines = machines(&bridge::live(&apart(&robot, &robot)).replace("[machine.base]\n", &listening));
    let mut runs = [start(&machines[0], "robot"), start(&machines[1], "base")];
    runs[1].wait_until("tracks arrive", || newest(&machines[1]) > 20);
    (machines, intruder(&[&robot, &base]), runs)
}

/// Records this number of messages and of heartbeats of the robot from the link.
fn recorded(session: &zenoh::Session, count: usize) -> Vec<(&'static str, Vec<u8>)> {
    let keys = ["conicflow/tracking/robot/ellipses", "conicflow/tracking/@link/robot"];
    let record = |key: &'static str| {
        let subscriber = session.declare_subscriber(key).wait().unwrap();
        (0..count).map(|_| (key, subscriber.recv().unwrap().payload().to_bytes().into_owned())).collect::<Vec<_>>()
    };
    keys.into_iter().flat_map(record).collect()
}

fn put(session: &zenoh::Session, messages: &[(&'static str, Vec<u8>)]) {
    messages.iter().for_each(|(key, bytes)| session.put(*key, bytes.clone()).wait().unwrap());
}

/// Asserts that a machine has each frame once, in order.
fn expect_in_order(base: &Playground) {
    let sequences = base.sequences("tracks.jsonl");
    assert!(sequences.is_sorted_by(|earlier, later| earlier < later), "{sequences:?}");
}

/// Position of the authentication code of a message, then of its stream, its number, and the number of the oldest kept message. A
/// heartbeat has the code at the same position.
const CODE: std::ops::Range<usize> = 14..46;
const STREAM: std::ops::Range<usize> = 46..54;
const NUMBER: std::ops::Range<usize> = 54..62;
const OLDEST: std::ops::Range<usize> = 62..70;

#[test]
fn messages_forged_without_the_key_pass_nowhere_and_are_reported() {
    let ([_robot, base], session, mut runs) = both_listening();
    let true_ones = recorded(&session, 3);
    let mut forged = Vec::new();
    for (index, (key, bytes)) in true_ones.iter().enumerate() {
        let mut far = bytes.clone();
        [NUMBER, OLDEST].into_iter().for_each(|place| far[place].copy_from_slice(&(1_u64 << 63).to_le_bytes()));
        let mut without_code = far.clone();
        without_code[CODE].fill(0);
        let elsewhere = true_ones[(index + 3) % 6].1.clone();
        forged.extend([far, without_code, elsewhere].map(|bytes| (*key, bytes)));
    }
    let before = newest(&base);
    runs[1].wait_until("tracks go on among the forged ones", || {
        put(&session, &forged);
        newest(&base) > before + 30
    });
    let mut edge = serde_json::Value::Null;
    runs[1].wait_until("the forged ones are counted", || {
        put(&session, &forged);
        edge = top_link(&base)["edges"][0].clone();
        edge["malformed"].as_u64().unwrap() > 3
    });
    assert!(edge["lost"].as_u64().unwrap() < 1000, "{edge}");
    let log = runs[1].stderr();
    for text in [
        "left out a message of topic `ellipses` from machine `robot`: it",
        "refused machine `robot`: its code was not made with the key of this machine\n  hint: are the keys of all",
        "refused machine `robot`: it has no code, and this machine takes only what was made with its key\n  hint: ",
    ] {
        assert!(log.contains(text), "no `{text}` in: {log}");
    }
    expect_in_order(&base);
    drop(runs.map(Started::end));
}

#[test]
fn messages_sent_before_a_bridge_was_restarted_are_refused_when_replayed() {
    let ([robot, base], session, mut runs) = both_listening();
    let old = recorded(&session, 5);
    kill(&robot, "bridge");
    wait_for_frames(&mut runs[1], &base, 20);
    wait_until("what is old is refused", || {
        put(&session, &old);
        let refused = "from machine `robot`: it is of an earlier start of the bridge there\n  hint: ";
        runs[1].stderr().contains(refused)
    });
    let before = newest(&base);
    runs[1].wait_until("tracks go on", || {
        put(&session, &old);
        newest(&base) > before + 20
    });
    expect_in_order(&base);
    drop(runs.map(Started::end));
}

/// Without a key, any session that connects can send in the name of a machine. Messages that the machine's bridge cannot have
/// sent are left out, and each message under way still arrives once.
#[test]
fn without_a_key_forged_messages_displace_none_of_a_lossless_edge() {
    let ends = [loopback(), loopback()];
    let text = apart(&ends[0], &ends[0]).replace("rate_hz    = 0", &format!("rate_hz = {}", bridge::LIVE_RATE_HZ));
    let text =
        text.replace("[machine.base]\n", &format!("[machine.base]\ninsecure = true\nlisten = [\"{}\"]\n", ends[1]));
    let [robot, base] = machines(&text.replace("[machine.robot]\n", "[machine.robot]\ninsecure = true\n"));
    let (robot_run, mut base_run) = (start(&robot, "robot"), start(&base, "base"));
    base_run.wait_until("tracks arrive", || newest(&base) > 20);
    let session = intruder(&[&ends[0], &ends[1]]);
    let [ellipses, beats] =
        ["robot/ellipses", "@link/robot"].map(|key| record(&session, &format!("conicflow/tracking/{key}")));
    let beats_of_base = record(&session, "conicflow/tracking/@link/base");
    let number = u64::from_le_bytes(ellipses[NUMBER].try_into().unwrap());
    let with = |bytes: &[u8], numbers: &[(std::ops::Range<usize>, u64)]| {
        let mut changed = bytes.to_vec();
        numbers.iter().for_each(|(place, number)| changed[place.clone()].copy_from_slice(&number.to_le_bytes()));
        changed
    };
    // After the code of a heartbeat come the numbers of its session and its run, and its time, each with a byte before it.
    const TIME: std::ops::Range<usize> = 65..73;
    assert_eq!([&beats, &beats_of_base].map(|bytes| bytes[TIME.start - 1]), [253; 2], "a number of eight bytes");
    let before = newest(&base);
    // A bridge accepts a message that is sent again if no other message contradicts it. On a busy machine it may happen that no
    // other message arrives in between, so each message is sent once.
    const FRAMES: u64 = 15;
    for round in 0..6 {
        let near = number + newest(&base) - before;
        let far = [(1 << 63) + round, u64::MAX - round, number + 1000 + round, round];
        let mut forged: Vec<_> = far.map(|number| with(&ellipses, &[(NUMBER, number), (OLDEST, number)])).into();
        forged.push(with(&ellipses, &[(STREAM, u64::MAX - round), (NUMBER, 0), (OLDEST, 0)]));
        for number in near..near + FRAMES {
            forged.push(match number % 3 {
                0 => with(&ellipses, &[(NUMBER, number), (OLDEST, number)]),
                1 => with(&ellipses, &[(NUMBER, number), (OLDEST, 0)]),
                _ => with(&ellipses, &[(NUMBER, number), (OLDEST, 0)])[..100].to_vec(),
            });
        }
        forged.iter().for_each(|bytes| session.put("conicflow/tracking/robot/ellipses", bytes.clone()).wait().unwrap());
        for (name, bytes) in [("robot", &beats), ("base", &beats_of_base)] {
            session.put(format!("conicflow/tracking/@link/{name}"), with(bytes, &[(TIME, u64::MAX)])).wait().unwrap();
        }
        wait_for_frames(&mut base_run, &base, FRAMES);
    }
    let edge = top_link(&base)["edges"][0].clone();
    assert!(edge["malformed"].as_u64() > Some(3) && edge["lost"] == 0, "{edge}");
    let report = "left out a message of topic `ellipses` that machine `robot` has not sent: what followed contradicts it\n  hint: ";
    assert!(base_run.stderr().contains(report), "{}", base_run.stderr());
    let made = robot_run.end().stage("source").messages;
    let ended = base_run.wait().expect_code(0);
    assert!(base.sequences("tracks.jsonl").into_iter().eq(0..made), "{}", ended.stderr);
}

/// Records the next message under a key from the link.
fn record(session: &zenoh::Session, key: &str) -> Vec<u8> {
    let subscriber = session.declare_subscriber(key).wait().unwrap();
    subscriber.recv().unwrap().payload().to_bytes().into_owned()
}

/// A pipeline of two machines with a key.
fn with_key(text: &str) -> String {
    ["robot", "base"].iter().fold(text.to_owned(), |text, name| {
        let title = format!("[machine.{name}]\n");
        text.replace(&title, &format!("{title}key = \"pair.key\"\n"))
    })
}

#[test]
fn machines_with_different_keys_report_it_and_machines_with_the_same_key_connect() {
    let endpoint = loopback();
    let [robot, base] = machines(&with_key(&bridge::live(&apart(&endpoint, &endpoint))));
    for machine in [&robot, &base] {
        machine.conicflow(&["key", "pair.key"]).expect_code(0);
    }
    let mut runs = [start(&robot, "robot"), start(&base, "base")];
    for (run, other) in runs.iter_mut().zip(["base", "robot"]) {
        run.wait_for_text(&format!(
            "refused machine `{other}`: its code was not made with the key of this machine\n  hint: are the keys of all \
             machines the same file?"
        ));
    }
    assert_eq!((newest(&base), top_link(&base)["was_heard"].as_bool()), (0, Some(false)));
    [&robot, &base].iter().for_each(|machine| wait_for_link(machine, "refused"));
    for run in runs {
        signal(run.id(), Signal::INT);
        run.wait();
    }
    std::fs::copy(robot.path("pair.key"), base.path("pair.key")).unwrap();
    let mut runs = [start(&robot, "robot"), start(&base, "base")];
    runs[1].wait_until("tracks arrive", || newest(&base) > 20);
    assert_eq!(top_link(&base)["edges"][0]["malformed"], 0);
    for ended in runs.map(Started::end) {
        assert!(!ended.stderr.contains("refused") && !ended.stderr.contains("left out"), "{}", ended.stderr);
    }
}

#[test]
fn a_key_is_made_once_and_refused_where_others_can_read_it() {
    let [robot, _] = machines(&with_key(&apart("tcp/0.0.0.0:7447", "tcp/192.168.0.2:7447")));
    let missing = robot.conicflow(&["validate"]).expect_code(2);
    missing.expect_texts(&["there is no file `", "pair.key`"]);
    let made = robot.conicflow(&["key", "pair.key"]).expect_code(0);
    assert!(made.stdout.contains("made `pair.key`: copy it to all machines"), "{}", made.stdout);
    let text = std::fs::read(robot.path("pair.key")).unwrap();
    let again = robot.conicflow(&["key", "pair.key"]).expect_code(2);
    again.expect_texts(&["there is a file `pair.key`, which is left as it is\n  hint: "]);
    assert_eq!(std::fs::read(robot.path("pair.key")).unwrap(), text);
    robot.conicflow(&["validate"]).expect_code(0);
    std::fs::set_permissions(robot.path("pair.key"), std::fs::Permissions::from_mode(0o644)).unwrap();
    for arguments in [&["validate"][..], &["run", "--machine", "robot"]] {
        let refused = robot.conicflow(arguments).expect_code(2);
        refused.expect_texts(&["is open to others, its mode is 644\n", "\n  hint: `chmod 600 "]);
    }
}

#[test]
fn a_key_is_for_all_machines_or_for_none() {
    let text = with_key(&apart("tcp/0.0.0.0:7447", "tcp/192.168.0.2:7447"));
    let [robot, _] = machines(&text.replace("[machine.base]\nkey = \"pair.key\"\n", "[machine.base]\n"));
    robot.conicflow(&["key", "pair.key"]).expect_code(0);
    let refused = robot.conicflow(&["validate"]).expect_code(2);
    refused.expect_texts(&["machine `base` has no `key`, but machine `robot` has one"]);
}
