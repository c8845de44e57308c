//! Machines that reach a Zenoh router, but not each other.

use super::bridge::{HALVES, live, loopback, newest, placed, start, top_link, tracks, wait_for_frames, wait_for_link};
use super::support::{Playground, Started, TRACKING, signal, wait_until};
use rustix::process::Signal;
use zenoh::Wait;

/// A Zenoh router in this process that listens on one endpoint, or on several separated by `", "`.
pub fn router(endpoint: &str) -> zenoh::Session {
    session("router", &[("listen/endpoints", &format!("[\"{endpoint}\"]"))])
}

/// A Zenoh session in this process that connects only to peers in its settings.
pub fn session(mode: &str, set: &[(&str, &str)]) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    let mode = format!("\"{mode}\"");
    let alone = [("mode", &*mode), ("scouting/multicast/enabled", "false"), ("listen/endpoints", "[]")];
    for (key, value) in alone.iter().chain(set) {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// Returns the playgrounds of a robot and a base that run the stages of `text`, each with its Zenoh settings.
pub fn by_router(text: &str, places: &[(&str, &str)], settings: [String; 2]) -> [Playground; 2] {
    let machines = "\n[machine.robot]\nzenoh = \"net.json5\"\n[machine.base]\nzenoh = \"net.json5\"\n";
    let text = placed(text, places) + machines;
    settings.map(|settings| {
        let machine = Playground::with_pipeline(&text);
        machine.write("net.json5", &settings);
        machine
    })
}

/// The settings of a machine that connects only to the router at these endpoints.
pub fn knows(mode: &str, endpoints: &[&str]) -> String {
    format!("{{ mode: '{mode}', connect: {{ endpoints: {endpoints:?} }} }}")
}

fn start_both([robot, base]: &[Playground; 2]) -> [Started; 2] {
    [start(robot, "robot"), start(base, "base")]
}

#[test]
fn nothing_is_lost_through_a_router() {
    let finite = TRACKING.replace("rate_hz    = 0", "rate_hz    = 0\nframes     = 80");
    let alone = Playground::with_pipeline(&finite);
    alone.conicflow(&["run"]).expect_code(0);
    for modes in [["client", "client"], ["peer", "client"]] {
        let endpoint = loopback();
        let _router = router(&endpoint);
        let machines = by_router(&finite, &HALVES, modes.map(|mode| knows(mode, &[&endpoint])));
        start_both(&machines).into_iter().for_each(|run| drop(run.wait().expect_code(0)));
        assert!(tracks(&machines[1]) == tracks(&alone), "{modes:?}");
    }
}

#[test]
fn peers_that_a_router_does_not_join_report_it() {
    let endpoint = loopback();
    let _router = router(&endpoint);
    let machines = by_router(TRACKING, &HALVES, [(); 2].map(|()| knows("peer", &[&endpoint])));
    for (run, other) in start_both(&machines).into_iter().zip(["base", "robot"]) {
        wait_until("it is told", || run.stderr().contains(&format!("nothing was heard of machine `{other}` in 5 s")));
        let machine = if other == "base" { &machines[0] } else { &machines[1] };
        let link = top_link(machine);
        assert_eq!(link["was_heard"], false, "{link}");
        assert_eq!(link["state"], "never", "the router is there: {link}");
        signal(run.id(), Signal::INT);
        signal(run.id(), Signal::INT);
        let ended = run.wait();
        assert!(ended.stderr.matches("nothing was heard").count() == 1, "{}", ended.stderr);
        let table = ended.stderr.lines().filter(|line| line.starts_with(other)).collect::<String>();
        assert!(table.contains(" never "), "{}", ended.stderr);
    }
}

#[test]
fn a_router_may_start_late_and_restart() {
    let endpoint = loopback();
    let machines = by_router(&live(TRACKING), &HALVES, [(); 2].map(|()| knows("client", &[&endpoint])));
    let mut runs = start_both(&machines);
    for run in &runs {
        wait_until("it waits for the router", || run.stderr().contains("cannot be opened yet"));
    }
    machines.iter().for_each(|machine| wait_for_link(machine, "unreachable"));
    for _ in 0..2 {
        let router = router(&endpoint);
        wait_for_frames(&mut runs[1], &machines[1], 20);
        wait_for_link(&machines[1], "up");
        router.close().wait().unwrap();
        wait_for_link(&machines[1], "unreachable");
    }
    drop(runs.map(Started::end));
}

#[test]
fn short_messages_use_datagrams_through_a_router_too() {
    let [stream, datagrams] = [loopback(), loopback().replace("tcp", "udp")];
    let places =
        [("source", "robot"), ("extractor", "robot"), ("assembler", "robot"), ("tracker", "base"), ("json", "base")];
    let settings = [(); 2].map(|()| knows("client", &[&stream, &datagrams]));
    let machines = by_router(&live(TRACKING), &places, settings);
    // The first router listens only on TCP, so it does not accept datagrams.
    let without = router(&stream);
    let mut runs = start_both(&machines);
    runs[1].wait_until("tracks arrive", || newest(&machines[1]) > 10);
    without.close().wait().unwrap();
    let _with = router(&format!("{stream}\", \"{datagrams}"));
    runs[1].wait_for_text("topic `objects` of machine `robot` comes by datagrams");
    wait_for_frames(&mut runs[1], &machines[1], 30);
    drop(runs.map(Started::end));
}
