//! Two hosts as network namespaces, joined by a cable that can be pulled and made bad. Needs root and `ip netns`; where
//! they are missing each test says so and shows nothing.

use super::bridge::{apart, machines, newest, tracks};
use super::support::{Playground, Started, TRACKING, signal, wait_until};
use rustix::process::{Signal, geteuid};
use std::io::BufRead;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

pub const ROBOT: &str = "10.77.0.1";
const BASE: &str = "10.77.0.2";
/// What is shown while the cable is out cannot come over it.
const OUTAGE: Duration = Duration::from_secs(3);
/// Longer than Zenoh, and TCP's first retries, wait.
const LONG_OUTAGE: Duration = Duration::from_secs(13);

/// Two network namespaces with a cable or a radio between them, gone when this is.
pub struct Hosts {
    robot: String,
    base: String,
    _radio: Option<Started>,
}

fn ip(arguments: &str) -> bool {
    let mut command = Command::new("ip");
    command.args(arguments.split_whitespace()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

impl Hosts {
    /// Hosts joined by a cable; `None`, said loudly, where this user cannot make them.
    pub fn new() -> Option<Self> {
        let hosts = Self::apart()?;
        let (robot, base) = (&hosts.robot, &hosts.base);
        assert!(ip(&format!("link add cable netns {robot} type veth peer name cable netns {base}")));
        hosts.set_up();
        Some(hosts)
    }

    /// Hosts joined by a radio: so many Mbit/s, 100 ms there and 100 ms back, and of 100 packets 5 are lost.
    pub fn with_radio(mbit_per_s: u32) -> Option<Self> {
        let mut hosts = Self::apart()?;
        if !Path::new("/dev/net/tun").exists() {
            eprintln!("SKIPPED: a radio needs python3 and /dev/net/tun; nothing was shown");
            return None;
        }
        let mut script = Command::new("python3");
        script.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/end_to_end/radio.py"));
        script.args([&hosts.robot, &hosts.base, &mbit_per_s.to_string(), "100", "5"]).stdin(Stdio::null());
        let (radio, mut says) = Started::piped(script);
        says.read_line(&mut String::new()).unwrap();
        hosts._radio = Some(radio);
        hosts.set_up();
        Some(hosts)
    }

    /// Hosts that nothing joins yet.
    fn apart() -> Option<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = format!("{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let hosts = Self { robot: format!("cfr{number}"), base: format!("cfb{number}"), _radio: None };
        if !geteuid().is_root() || !ip(&format!("netns add {}", hosts.robot)) {
            eprintln!("SKIPPED: network namespaces need root and `ip netns`; nothing was shown");
            return None;
        }
        assert!(ip(&format!("netns add {}", hosts.base)));
        Some(hosts)
    }

    fn set_up(&self) {
        let (robot, base) = (&self.robot, &self.base);
        let steps = [
            format!("-n {robot} addr add {ROBOT}/24 dev cable"),
            format!("-n {base} addr add {BASE}/24 dev cable"),
            format!("-n {robot} link set lo up"),
            format!("-n {base} link set lo up"),
            format!("-n {robot} link set cable up"),
            format!("-n {base} link set cable up"),
        ];
        steps.iter().for_each(|step| assert!(ip(step), "ip {step}"));
    }

    /// Pulls the cable, or puts it back.
    pub fn cable(&self, state: &str) {
        assert!(ip(&format!("-n {} link set cable {state}", self.robot)));
    }

    /// Makes the cable as bad as this kernel can: slow, long and lossy, or at least slow. False, said loudly, if not.
    fn spoil(&self, rate: &str) -> bool {
        let shaped = |discipline: &str| {
            [&self.robot, &self.base].iter().all(|host| {
                let arguments = format!("-n {host} qdisc add dev cable root {discipline}");
                let mut command = Command::new("tc");
                command.args(arguments.split_whitespace()).stderr(Stdio::null());
                command.status().is_ok_and(|status| status.success())
            })
        };
        if shaped(&format!("netem rate {rate} delay 50ms loss 5%")) {
            return true;
        }
        let slow = shaped(&format!("tbf rate {rate} burst 64kb latency 100ms"));
        let missing = if slow { "delay and loss" } else { "a bad cable" };
        eprintln!("SKIPPED: this kernel has no netem; {missing} was not shown");
        slow
    }

    /// Starts the machine of this name on its host.
    pub fn start(&self, playground: &Playground, machine: &str) -> Started {
        let host = if machine == "robot" { &self.robot } else { &self.base };
        let inner = playground.command(&["run", "--machine", machine]);
        let mut command = Command::new("ip");
        command.args(["netns", "exec", host]).arg(inner.get_program()).args(inner.get_args()).stdin(Stdio::null());
        for (name, value) in inner.get_envs() {
            match value {
                Some(value) => command.env(name, value),
                None => command.env_remove(name),
            };
        }
        command.current_dir(playground.path(""));
        Started::new(command)
    }

    pub fn start_both(&self, [robot, base]: &[Playground; 2]) -> [Started; 2] {
        [self.start(robot, "robot"), self.start(base, "base")]
    }
}

impl Drop for Hosts {
    fn drop(&mut self) {
        [&self.robot, &self.base].iter().for_each(|host| {
            ip(&format!("netns del {host}"));
        });
    }
}

fn text() -> String {
    let endpoint = format!("tcp/{ROBOT}:7447");
    apart(&endpoint, &endpoint).replace("[machine.robot]\n", "[machine.robot]\ninsecure = true\n")
}

fn live() -> [Playground; 2] {
    machines(&text().replace(", delivery = \"lossless\"", "").replace("rate_hz    = 0", "rate_hz = 30"))
}

pub fn end(runs: [Started; 2]) -> [super::support::Ended; 2] {
    runs.map(|run| {
        signal(run.id(), Signal::INT);
        run.wait().expect_code(0)
    })
}

/// Pulls the cable for a while under live edges: what was lost is lost, what comes is fresh, and the robot feels nothing.
fn pull_the_cable(outage: Duration) {
    let Some(hosts) = Hosts::new() else { return };
    let machines = live();
    let base = &machines[1];
    let mut runs = hosts.start_both(&machines);
    runs[1].wait_until("tracks arrive", || newest(base) > 30);
    hosts.cable("down");
    std::thread::sleep(outage);
    let (lines, before) = (base.lines("tracks.jsonl").len(), newest(base));
    hosts.cable("up");
    let since = Instant::now();
    runs[1].wait_until("tracks arrive again", || newest(base) > before);
    eprintln!("after {outage:?} without a cable tracks came again {:?} after it was back", since.elapsed());
    runs[1].wait_until("they go on", || newest(base) > before + 60);
    let [robot_ended, _] = end(runs);
    for line in &base.json_lines("tracks.jsonl")[lines..] {
        assert!(line["latency_ms"].as_f64().unwrap() < 1500.0, "a stale backlog: {line}");
    }
    let depth = robot_ended.input("depth", "extractor");
    assert!(depth.dropped <= depth.received / 10, "the robot felt it: {depth:?}");
}

#[test]
fn after_an_outage_live_edges_carry_what_is_new() {
    pull_the_cable(OUTAGE);
}

#[test]
#[ignore = "takes half a minute; cargo test -- --ignored"]
fn after_an_outage_longer_than_any_lease_too() {
    pull_the_cable(LONG_OUTAGE);
}

/// Lossless edges over a bad cable give, bit for bit, what one machine finds.
pub fn nothing_is_lost(hosts: &Hosts, disturb: impl FnOnce()) {
    const FRAMES: &str = "200";
    let alone = Playground::with_pipeline(TRACKING);
    alone.conicflow(&["run", "--frames", FRAMES, "--set", "source.rate_hz=40"]).expect_code(0);
    let paced = text().replace("rate_hz    = 0", &format!("rate_hz = 40\nframes = {FRAMES}"));
    let machines = machines(&paced);
    let mut runs = hosts.start_both(&machines);
    runs[1].wait_until("tracks arrive", || newest(&machines[1]) > 20);
    disturb();
    let ended = runs.map(|run| run.wait().expect_code(0));
    assert!(tracks(&machines[1]) == tracks(&alone), "{}\n{}", ended[0].stderr, ended[1].stderr);
    machines.iter().for_each(|machine| wait_until("no process is left", || machine.processes().is_empty()));
}

fn nothing_is_lost_to(outage: Duration) {
    let Some(hosts) = Hosts::new() else { return };
    nothing_is_lost(&hosts, || {
        hosts.cable("down");
        std::thread::sleep(outage);
        hosts.cable("up");
    });
}

#[test]
fn lossless_edges_lose_nothing_to_an_outage() {
    nothing_is_lost_to(OUTAGE);
}

#[test]
#[ignore = "takes half a minute; cargo test -- --ignored"]
fn lossless_edges_lose_nothing_to_an_outage_longer_than_any_lease_either() {
    nothing_is_lost_to(LONG_OUTAGE);
}

#[test]
fn lossless_edges_lose_nothing_to_a_slow_cable_that_drops_packets() {
    let Some(hosts) = Hosts::new() else { return };
    if !hosts.spoil("50mbit") {
        return;
    }
    nothing_is_lost(&hosts, || {});
}

fn base_lines(base: &Playground) -> usize {
    base.lines("tracks.jsonl").len()
}

#[test]
fn a_slow_cable_full_of_images_is_not_felt_on_the_robot() {
    let Some(hosts) = Hosts::new() else { return };
    if !hosts.spoil("2mbit") {
        return;
    }
    // These images, uncompressed, are half as much again as the cable carries.
    let endpoint = format!("tcp/{ROBOT}:7447");
    let text = format!(
        r#"
name = "images"
[machine.robot]
listen   = ["{endpoint}"]
insecure = true
[machine.base]
connect  = ["{endpoint}"]
[stage.source]
node    = "synthetic_source"
machine = "robot"
output  = "depth"
width   = 64
height  = 48
rate_hz = 60
intrinsics = {{ fx = 200, fy = 200, cx = 31.5, cy = 23.5 }}
[stage.local]
node    = "row_ellipse_extractor"
machine = "robot"
input   = "depth"
output  = "ellipses"
[stage.remote]
node    = "row_ellipse_extractor"
machine = "base"
input   = {{ topic = "depth", compression = "none" }}
output  = "found"
[stage.json]
node    = "json_sink"
machine = "base"
input   = "found"
path    = "tracks.jsonl"
"#
    );
    let machines = machines(&text);
    let mut runs = hosts.start_both(&machines);
    runs[1].wait_until("images arrive", || base_lines(&machines[1]) > 100);
    let [robot, base] = end(runs);
    let local = robot.input("depth", "local");
    for line in &machines[1].json_lines("tracks.jsonl")[5..] {
        assert!(line["latency_ms"].as_f64().unwrap() < 1500.0, "a queue on the cable: {line}");
    }
    assert!(local.dropped <= local.received / 10, "the robot felt it: {local:?}");
    eprintln!("over a slow cable: {}", base.stderr.lines().filter(|line| line.contains(" in ")).collect::<String>());
}
