//! Two hosts as network namespaces, joined by a cable that can be pulled and disturbed. The tests need root and `ip netns`;
//! without these they print that they are skipped.

use super::bridge::{LIVE_RATE_HZ, apart, expect_unfelt, live, machines, newest, tracks};
use super::support::{Playground, Started, TRACKING, wait_until, within};
use rustix::process::geteuid;
use serde_json::Value as Json;
use std::io::BufRead;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

pub const ROBOT: &str = "10.77.0.1";
const BASE: &str = "10.77.0.2";
/// Times for which the cable is pulled. The second one is longer than Zenoh and the first retries of TCP wait, and long enough
/// for a stale backlog.
const OUTAGES: [Duration; 2] = [Duration::from_secs(3), Duration::from_secs(13)];
/// Maximum time until a link is up again.
const SOON: Duration = Duration::from_secs(3);
/// Latency in milliseconds above which a message is stale: it waited in a queue, or for a stage on a busy host.
const STALE_MS: f64 = 2500.0;
/// At most this many stale messages may arrive, those of two seconds; a backlog has more.
pub const MOST_STALE: usize = 40;

/// Number of latencies of stale messages.
pub fn stale(latencies_ms: impl IntoIterator<Item = f64>) -> usize {
    latencies_ms.into_iter().filter(|latency_ms| *latency_ms > STALE_MS).count()
}

/// Number of stale lines of results.
fn stale_lines(lines: &[Json]) -> usize {
    stale(lines.iter().map(|line| line["latency_ms"].as_f64().unwrap()))
}

/// A network namespace, which is removed when this value is dropped.
pub struct Host(String);

/// Two hosts with a cable or a radio between them.
pub struct Hosts {
    robot: Host,
    base: Host,
    _radio: Option<Started>,
}

pub fn ip(arguments: &str) -> bool {
    let mut command = Command::new("ip");
    command.args(arguments.split_whitespace()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

impl Host {
    /// Creates a host without a cable. If this user cannot, prints that the test is skipped, and returns `None`.
    pub fn new() -> Option<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let host = Self(format!("cf{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed)));
        if !geteuid().is_root() || !ip(&format!("netns add {}", host.name())) {
            eprintln!("SKIPPED: network namespaces need root and `ip netns`; nothing was shown");
            return None;
        }
        host.ip("link set lo up");
        Some(host)
    }

    /// Name of the namespace.
    pub fn name(&self) -> &str {
        &self.0
    }

    /// Runs `ip` on this host.
    pub fn ip(&self, arguments: &str) {
        assert!(ip(&format!("-n {} {arguments}", self.0)), "ip {arguments}");
    }

    /// Gives one of its devices an address.
    pub fn address(&self, device: &str, address: &str) {
        self.ip(&format!("addr add {address}/24 dev {device}"));
        self.ip(&format!("link set {device} up"));
    }

    /// Starts a program on this host.
    pub fn start(&self, inner: &Command) -> Started {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.0]);
        inner.get_current_dir().map(|folder| command.current_dir(folder));
        Started::new(within(command, inner))
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        ip(&format!("netns del {}", self.0));
    }
}

impl Hosts {
    /// Creates hosts joined by a cable. If this user cannot, prints that the test is skipped, and returns `None`.
    pub fn new() -> Option<Self> {
        let hosts = Self::apart()?;
        let (robot, base) = (hosts.robot.name(), hosts.base.name());
        assert!(ip(&format!("link add cable netns {robot} type veth peer name cable netns {base}")));
        hosts.set_up();
        Some(hosts)
    }

    /// Creates hosts joined by a radio with this rate in Mbit/s, a delay of 100 ms in each direction, and a loss of 5 of 100
    /// packets.
    pub fn with_radio(mbit_per_s: u32) -> Option<Self> {
        let mut hosts = Self::apart()?;
        if !Path::new("/dev/net/tun").exists() {
            eprintln!("SKIPPED: a radio needs python3 and /dev/net/tun; nothing was shown");
            return None;
        }
        let mut script = Command::new("python3");
        script.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/end_to_end/radio.py"));
        script.args([hosts.robot.name(), hosts.base.name(), &mbit_per_s.to_string(), "100", "5"]).stdin(Stdio::null());
        let (radio, mut says) = Started::piped(script);
        says.read_line(&mut String::new()).unwrap();
        hosts._radio = Some(radio);
        hosts.set_up();
        Some(hosts)
    }

    /// Creates two hosts that are not joined.
    fn apart() -> Option<Self> {
        Some(Self { robot: Host::new()?, base: Host::new()?, _radio: None })
    }

    fn set_up(&self) {
        self.robot.address("cable", ROBOT);
        self.base.address("cable", BASE);
    }

    /// Pulls the cable, or puts it back.
    pub fn cable(&self, state: &str) {
        self.robot.ip(&format!("link set cable {state}"));
    }

    /// Makes the cable as bad as this kernel can: slow, with delay and loss, or at least slow. If the kernel cannot, prints that
    /// the test is skipped, and returns `false`.
    fn spoil(&self, rate: &str) -> bool {
        let shaped = |discipline: &str| {
            [&self.robot, &self.base].iter().all(|host| {
                let arguments = format!("-n {} qdisc add dev cable root {discipline}", host.name());
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
        host.start(&playground.command(&["run", "--machine", machine]))
    }

    pub fn start_both(&self, [robot, base]: &[Playground; 2]) -> [Started; 2] {
        [self.start(robot, "robot"), self.start(base, "base")]
    }
}

fn text() -> String {
    let endpoint = format!("tcp/{ROBOT}:7447");
    apart(&endpoint, &endpoint).replace("[machine.robot]\n", "[machine.robot]\ninsecure = true\n")
}

/// Pulls the cable under live edges: messages of that time are lost, new ones arrive in time, and the robot is not affected.
#[test]
fn after_an_outage_live_edges_carry_new_messages() {
    let Some(hosts) = Hosts::new() else { return };
    let machines = machines(&live(&text()));
    let base = &machines[1];
    let mut runs = hosts.start_both(&machines);
    runs[1].wait_until("tracks arrive", || newest(base) > 20);
    for outage in OUTAGES {
        let (before, pulled) = (newest(base), Instant::now());
        hosts.cable("down");
        std::thread::sleep(outage);
        let lines = base.lines("tracks.jsonl").len();
        hosts.cable("up");
        let (down, back) = (pulled.elapsed(), Instant::now());
        runs[1].wait_until("tracks arrive again", || base.lines("tracks.jsonl").len() > lines);
        eprintln!("after {outage:?} without a cable tracks came again {:?} after it was back", back.elapsed());
        // A backlog would end before this frame, too.
        let fresh = newest(base).max(before + (LIVE_RATE_HZ * down.as_secs_f64()) as u64);
        runs[1].wait_until("they go on", || newest(base) > fresh + 40);
        let after = &base.json_lines("tracks.jsonl")[lines..];
        // The sequence numbers of frames give the time, however busy this host is.
        let missed = after[0]["sequence"].as_u64().unwrap() - before;
        assert!(
            missed as f64 <= LIVE_RATE_HZ * (down + SOON).as_secs_f64(),
            "{missed} frames in an outage of {down:?}"
        );
        let stale = stale_lines(after);
        assert!(outage < OUTAGES[1] || stale <= MOST_STALE, "a stale backlog of {stale}");
    }
    let [robot_ended, _] = runs.map(Started::end);
    expect_unfelt(&robot_ended.input("depth", "extractor"));
}

/// Asserts that lossless edges over a bad cable give the same results as one machine to the bit. `disturb` gets the playground of
/// the base, whose results show the progress.
pub fn nothing_is_lost(hosts: &Hosts, frames: u64, disturb: impl FnOnce(&Playground)) {
    let alone = Playground::with_pipeline(TRACKING);
    alone.conicflow(&["run", "--frames", &frames.to_string(), "--set", "source.rate_hz=40"]).expect_code(0);
    let paced = text().replace("rate_hz    = 0", &format!("rate_hz = 40\nframes = {frames}"));
    let machines = machines(&paced);
    let mut runs = hosts.start_both(&machines);
    runs[1].wait_until("tracks arrive", || newest(&machines[1]) > 20);
    disturb(&machines[1]);
    let ended = runs.map(|run| run.wait().expect_code(0));
    assert!(tracks(&machines[1]) == tracks(&alone), "{}\n{}", ended[0].stderr, ended[1].stderr);
    machines.iter().for_each(|machine| wait_until("no process is left", || machine.processes().is_empty()));
}

#[test]
fn lossless_edges_lose_nothing_in_an_outage() {
    let Some(hosts) = Hosts::new() else { return };
    // More frames than both sides keep while the cable is out.
    const FRAMES: u64 = 200;
    nothing_is_lost(&hosts, FRAMES, |base| {
        for outage in OUTAGES {
            let before = newest(base);
            hosts.cable("down");
            std::thread::sleep(outage);
            hosts.cable("up");
            wait_until("tracks arrive again", || newest(base) >= (before + 10).min(FRAMES - 1));
        }
    });
}

#[test]
fn lossless_edges_lose_nothing_over_a_slow_cable_that_drops_packets() {
    let Some(hosts) = Hosts::new() else { return };
    if !hosts.spoil("50mbit") {
        return;
    }
    nothing_is_lost(&hosts, 100, |_| {});
}

#[test]
fn a_slow_cable_full_of_images_does_not_delay_the_robot() {
    let Some(hosts) = Hosts::new() else { return };
    if !hosts.spoil("0.5mbit") {
        return;
    }
    // These uncompressed images need twice the rate of the cable.
    let endpoint = format!("tcp/{ROBOT}:7447");
    let text = format!(
        r#"
name = "images"

[machine]
robot = {{ listen = ["{endpoint}"], insecure = true }}
base  = {{ connect = ["{endpoint}"] }}

[stage.source]
node       = "synthetic_source"
machine    = "robot"
output     = "depth"
width      = 64
height     = 48
rate_hz    = 20
intrinsics = {{ fx = 200, fy = 200, cx = 31.5, cy = 23.5 }}

[stage]
local  = {{ machine = "robot", node = "row_ellipse_extractor", input = "depth", output = "ellipses" }}
found  = {{ machine = "base", node = "object_assembler", input = "again", output = "found" }}
json   = {{ machine = "base", node = "json_sink", input = "found", path = "tracks.jsonl" }}

[stage.remote]
node    = "row_ellipse_extractor"
machine = "base"
input   = {{ topic = "depth", compression = "none" }}
output  = "again"
"#
    );
    let machines = machines(&text);
    let mut runs = hosts.start_both(&machines);
    runs[1].wait_until("images arrive", || machines[1].lines("tracks.jsonl").len() > 120);
    let [robot, base] = runs.map(Started::end);
    // A queue on the cable would grow all the time, and messages of the second half would be stale.
    let stale = stale_lines(&machines[1].json_lines("tracks.jsonl")[5..]);
    assert!(stale <= MOST_STALE, "a queue on the cable: {stale} came late");
    expect_unfelt(&robot.input("depth", "local"));
    eprintln!("over a slow cable: {}", base.stderr.lines().filter(|line| line.contains(" in ")).collect::<String>());
}
