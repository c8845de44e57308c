//! Three hosts as network namespaces: two that cannot reach each other, and one between them that reaches both. The tests need
//! root and `ip netns`; without these they print that they are skipped.

use super::bridge::{HALVES, placed, tracks};
use super::hosts::{Host, ip};
use super::programs::router;
use super::routers::{by_router, knows};
use super::support::{Playground, Started, TRACKING, wait_until};
use std::time::Duration;

/// The addresses of the host in the middle, towards each of the others.
const HUB: [&str; 2] = ["10.78.1.3", "10.78.2.3"];
const ENDS: [&str; 2] = ["10.78.1.1", "10.78.2.2"];
const OUTAGE: Duration = Duration::from_secs(3);

/// Two hosts, each with a cable to the third.
struct Star {
    ends: [Host; 2],
    hub: Host,
}

impl Star {
    fn new() -> Option<Self> {
        let star = Self { ends: [Host::new()?, Host::new()?], hub: Host::new()? };
        let hub = star.hub.name();
        for (index, end) in star.ends.iter().enumerate() {
            let end_name = end.name();
            assert!(ip(&format!("link add cable netns {end_name} type veth peer name cable{index} netns {hub}")));
            end.address("cable", ENDS[index]);
            star.hub.address(&format!("cable{index}"), HUB[index]);
            let other = ENDS[1 - index];
            assert!(!ip(&format!("-n {end_name} route get {other}")), "the ends reach each other");
        }
        Some(star)
    }
}

/// [`TRACKING`] with more frames than all machines can keep while a cable is unplugged.
fn finite() -> String {
    TRACKING.replace("rate_hz    = 0", "rate_hz    = 60\nframes     = 200")
}

fn found_by_one_machine() -> Vec<serde_json::Value> {
    let alone = Playground::with_pipeline(&finite());
    alone.conicflow(&["run"]).expect_code(0);
    tracks(&alone)
}

fn run(host: &Host, playground: &Playground, machine: &str) -> Started {
    host.start(&playground.command(&["run", "--machine", machine]))
}

#[test]
fn three_hosts_share_a_pipeline_and_lose_nothing_when_a_cable_is_pulled() {
    let Some(star) = Star::new() else { return };
    // Images go to the desk, and ellipses on to the base. Objects come back to the desk, and tracks to the robot.
    let places =
        [("source", "robot"), ("extractor", "desk"), ("assembler", "base"), ("tracker", "desk"), ("json", "robot")];
    let [to_robot, to_base] = HUB.map(|address| format!("tcp/{address}:7447"));
    let text = placed(&finite(), &places)
        + &format!(
            "\n[machine.desk]\ninsecure = true\nlisten = [\"{to_robot}\", \"{to_base}\"]\n\
             [machine.robot]\nconnect = [\"{to_robot}\"]\n[machine.base]\nconnect = [\"{to_base}\"]\n"
        );
    let machines = [(); 3].map(|()| Playground::with_pipeline(&text));
    let [robot, base, desk] = &machines;
    let mut runs = [run(&star.ends[0], robot, "robot"), run(&star.ends[1], base, "base"), run(&star.hub, desk, "desk")];
    runs[0].wait_until("tracks come back", || robot.count("tracks.jsonl") > 20);
    star.ends[1].ip("link set cable down");
    std::thread::sleep(OUTAGE);
    star.ends[1].ip("link set cable up");
    runs.into_iter().for_each(|run| drop(run.wait().expect_code(0)));
    assert!(tracks(robot) == found_by_one_machine());
    machines.iter().for_each(|machine| wait_until("no process is left", || machine.processes().is_empty()));
}

#[test]
fn two_sites_that_reach_nothing_but_a_router_lose_nothing() {
    let Some(star) = Star::new() else { return };
    let endpoints = HUB.map(|address| format!("tcp/{address}:7447"));
    let router = router(&endpoints);
    let settings = endpoints.map(|endpoint| knows("client", &[&endpoint]));
    let machines = by_router(&finite(), &HALVES, settings);
    // The router starts last, and restarts later.
    let mut runs = [run(&star.ends[0], &machines[0], "robot"), run(&star.ends[1], &machines[1], "base")];
    let first = star.hub.start(&router);
    runs[1].wait_until("tracks arrive", || machines[1].count("tracks.jsonl") > 20);
    let arrived = machines[1].count("tracks.jsonl");
    assert!(arrived < 150, "{arrived} of 200 frames had arrived before the router died");
    drop(first);
    let _second = star.hub.start(&router);
    runs.into_iter().for_each(|run| drop(run.wait().expect_code(0)));
    assert!(tracks(&machines[1]) == found_by_one_machine());
}
