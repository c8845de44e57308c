//! Who gets in where links are TLS: certificates of one authority, and of those only the ones on the list.

use super::bridge::{self, apart, loopback, machines, newest, start, wait_for_frames};
use super::routers::session;
use super::support::{Playground, Started, wait_until};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use zenoh::Wait;

/// Both machines, live, joined by TLS with the settings in `tls/`.
fn live(endpoint: &str) -> [Playground; 2] {
    let text = bridge::live(&apart(endpoint, endpoint))
        .replace("[machine.robot]\n", "[machine.robot]\nzenoh = \"tls/robot.json5\"\n")
        .replace("[machine.base]\n", "[machine.base]\nzenoh = \"tls/base.json5\"\n");
    machines(&text)
}

/// Makes an authority in a folder, and certificates for these machines at this address; false, said loudly, where that
/// cannot be done.
pub fn make_certificates(folder: &Path, names: &[&str], address: &str) -> bool {
    let mut script = Command::new(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/tls/certificates.sh"));
    script.arg(folder).args(names.iter().map(|name| format!("{name}={address}")));
    let made = script.status().is_ok_and(|status| status.success());
    if !made {
        eprintln!("SKIPPED: there is no `openssl`; nothing was shown");
    }
    made
}

/// Gives the base its own from the folder of the robot, where all were made.
pub fn hand_over(robot: &Playground, base: &Playground) {
    std::fs::create_dir_all(base.path("tls")).unwrap();
    for file in ["tls/base.json5", "tls/base.key", "tls/base.pem", "tls/ca.pem"] {
        std::fs::copy(robot.path(file), base.path(file)).unwrap();
    }
}

fn tls_loopback() -> String {
    loopback().replace("tcp/127.0.0.1", "tls/localhost")
}

#[test]
fn only_who_has_the_right_certificate_gets_in() {
    let endpoint = tls_loopback();
    let [robot, base] = live(&endpoint);
    if !make_certificates(&robot.path("tls"), &["robot", "base"], "localhost") {
        return;
    }
    let another_authority = base.path("tls");
    assert!(make_certificates(&another_authority, &["robot", "base"], "localhost"));
    let robot_run = start(&robot, "robot");
    // Another authority's certificate, then none, then the right one.
    for stage in ["wrong", "none", "right"] {
        if stage == "none" {
            let only_ca = "{ transport: { link: { tls: { root_ca_certificate: 'ca.pem' } } } }";
            base.write("tls/base.json5", only_ca);
            std::fs::copy(robot.path("tls/ca.pem"), base.path("tls/ca.pem")).unwrap();
        } else if stage == "right" {
            hand_over(&robot, &base);
        }
        let mut base_run = start(&base, "base");
        if stage == "right" {
            base_run.wait_until("tracks arrive", || newest(&base) > 0);
        } else {
            // Long enough for many attempts; the right certificate takes a tenth of it.
            let since = Instant::now();
            wait_until("attempts were made", || since.elapsed() > Duration::from_secs(4));
            assert_eq!(base.lines("tracks.jsonl").len(), 0, "{stage}");
        }
        base_run.end();
    }
    robot_run.end();
}

#[test]
fn datagrams_may_be_encrypted_too() {
    let [stream, datagrams] = [tls_loopback(), loopback()];
    let datagrams = datagrams.replace("tcp/127.0.0.1", "quic/localhost") + "?rel=0";
    let machines = live(&format!("{stream}\", \"{datagrams}")).map(|machine| {
        let text = std::fs::read_to_string(machine.path("pipeline.toml")).unwrap();
        let text = text.replace("[stage.assembler]\nmachine = \"base\"", "[stage.assembler]\nmachine = \"robot\"");
        machine.write("pipeline.toml", &text);
        machine
    });
    let [robot, base] = &machines;
    if !make_certificates(&robot.path("tls"), &["robot", "base"], "localhost") {
        return;
    }
    hand_over(robot, base);
    let mut runs = [start(robot, "robot"), start(base, "base")];
    runs[1].wait_for_text("topic `objects` of machine `robot` comes by datagrams");
    wait_for_frames(&mut runs[1], base, 30);
    drop(runs.map(Started::end));
}

/// Somebody with a certificate of the authority, who reads and writes what is not theirs.
struct Guest {
    session: zenoh::Session,
    heard: Arc<AtomicU64>,
    _ears: Vec<zenoh::pubsub::Subscriber<()>>,
}

impl Guest {
    fn new(endpoint: &str, folder: &Path) -> Self {
        let file = |name: &str| format!("\"{}\"", folder.join(name).display());
        let set = [
            ("connect/endpoints", &*format!("[\"{endpoint}\"]")),
            ("transport/link/tls/root_ca_certificate", &file("ca.pem")),
            ("transport/link/tls/connect_private_key", &file("guest.key")),
            ("transport/link/tls/connect_certificate", &file("guest.pem")),
            ("transport/link/tls/enable_mtls", "true"),
        ];
        let session = session("peer", &set);
        let heard = Arc::new(AtomicU64::new(0));
        let listen = |key: &str| {
            let heard = Arc::clone(&heard);
            let hear = move |_| {
                heard.fetch_add(1, Ordering::Relaxed);
            };
            session.declare_subscriber(format!("conicflow/tracking/{key}")).callback(hear).wait().unwrap()
        };
        let ears = ["robot/*", "@link/robot"].map(listen).into();
        Self { session, heard, _ears: ears }
    }

    /// Claims to be the base, of another version.
    fn lie(&self) {
        self.session.put("conicflow/tracking/@link/base", b"CFLO\x63\x00".as_slice()).wait().unwrap();
    }
}

#[test]
fn who_is_not_on_the_list_can_neither_read_nor_write() {
    const EXAMPLE: &str = include_str!("../../examples/tls/access_control.json5");
    let endpoint = tls_loopback();
    let [robot, base] = live(&endpoint);
    let folder = robot.path("tls");
    if !make_certificates(&folder, &["robot", "base", "guest"], "localhost") {
        return;
    }
    // Keys have an `@` of their own.
    let exchanged = EXAMPLE.replace("robot", "%").replace("base", "robot").replace('%', "base");
    hand_over(&robot, &base);
    for listed in [false, true] {
        if listed {
            robot.write("tls/robot.json5", EXAMPLE);
            base.write("tls/base.json5", &exchanged);
        }
        let (robot_run, mut base_run) = (start(&robot, "robot"), start(&base, "base"));
        base_run.wait_until("tracks arrive", || newest(&base) > 10);
        let guest = Guest::new(&endpoint, &folder);
        let before = newest(&base);
        base_run.wait_until("tracks go on", || {
            guest.lie();
            newest(&base) > before + 60
        });
        let (heard, noticed) = (guest.heard.load(Ordering::Relaxed), robot_run.stderr().contains("version 99"));
        assert_eq!([heard == 0, !noticed], [listed; 2], "{heard} messages; {}", robot_run.stderr());
        drop([base_run, robot_run].map(Started::end));
    }
}
