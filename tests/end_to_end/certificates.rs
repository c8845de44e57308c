//! Access to links with TLS: only machines with a certificate of the authority and a name on the list may connect.

use super::bridge::{self, apart, loopback, machines, newest, start, top_link, wait_for_frames};
use super::routers::session;
use super::support::{Playground, Started};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use zenoh::Wait;

/// The live pipeline file of both machines, joined by TLS with the settings in `tls/`.
fn live_text(endpoint: &str) -> String {
    bridge::live(&apart(endpoint, endpoint))
        .replace("[machine.robot]\n", "[machine.robot]\nzenoh = \"tls/robot.json5\"\n")
        .replace("[machine.base]\n", "[machine.base]\nzenoh = \"tls/base.json5\"\n")
}

/// Both machines.
fn live(endpoint: &str) -> [Playground; 2] {
    machines(&live_text(endpoint))
}

/// Creates an authority in a folder, and certificates for these machines at this address. If that is impossible, prints that the
/// test is skipped, and returns `false`.
pub fn make_certificates(folder: &Path, names: &[&str], address: &str) -> bool {
    let mut script = Command::new(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/tls/certificates.sh"));
    script.arg(folder).args(names.iter().map(|name| format!("{name}={address}")));
    let made = script.status().is_ok_and(|status| status.success());
    if !made {
        eprintln!("SKIPPED: there is no `openssl`; nothing was shown");
    }
    made
}

/// Copies the files of the base from the folder of the robot, in which all were created.
pub fn hand_over(robot: &Playground, base: &Playground) {
    std::fs::create_dir_all(base.path("tls")).unwrap();
    for file in ["tls/base.json5", "tls/base.key", "tls/base.pem", "tls/ca.pem"] {
        std::fs::copy(robot.path(file), base.path(file)).unwrap();
    }
}

fn tls_loopback() -> String {
    loopback().replace("tcp/127.0.0.1", "tls/localhost")
}

/// Renews the certificate of a machine with this validity, signed by the authority in a folder.
fn make_for_time(folder: &Path, name: &str, [from, until]: [&str; 2]) {
    const AUTHORITY: &str = "[ca]\ndefault_ca=own\n[own]\ndatabase=index.txt\nrand_serial=yes\nnew_certs_dir=.\n\
                             default_md=sha256\npolicy=any\nx509_extensions=all\nunique_subject=no\n\
                             [any]\ncommonName=supplied\n[all]\n\
                             subjectAltName=DNS:localhost\nbasicConstraints=CA:FALSE\nextendedKeyUsage=serverAuth,clientAuth\n";
    std::fs::write(folder.join("authority.cnf"), AUTHORITY).unwrap();
    std::fs::write(folder.join("index.txt"), "").unwrap();
    let (key, certificate, subject) = (format!("{name}.key"), format!("{name}.pem"), format!("/CN={name}"));
    let asked: &[&str] = &["req", "-new", "-key", &key, "-subj", &subject, "-out", "asked.csr"];
    let authority = ["ca", "-batch", "-notext", "-config", "authority.cnf", "-cert", "ca.pem", "-keyfile", "ca.key"];
    let times = ["-startdate", from, "-enddate", until, "-in", "asked.csr", "-out", &certificate];
    for arguments in [asked, &[&authority[..], &times].concat()] {
        let made = Command::new("openssl").current_dir(folder).args(arguments).output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    }
}

#[test]
fn only_a_machine_with_the_right_certificate_connects_and_both_sides_report_why_another_is_refused() {
    const PAST: [&str; 2] = ["20200101000000Z", "20200102000000Z"];
    const FUTURE: [&str; 2] = ["22000101000000Z", "22000102000000Z"];
    let endpoint = tls_loopback();
    let [robot, base] = live(&endpoint);
    let (folder, another_authority) = (robot.path("tls"), base.path("other"));
    let names = ["robot", "base"];
    if !make_certificates(&folder, &names, "localhost") || !make_certificates(&another_authority, &names, "localhost") {
        return;
    }
    let mut robot_run = start(&robot, "robot");
    let comes = "refused somebody who connects: its certificate ";
    let there = format!("the machine at `{endpoint}` refuses this machine: ");
    let out_of_time = there.clone() + "by the clock there its certificate has expired, or is not valid yet\n  hint: ";
    for (what, at_robot, at_base) in [
        ("other", &*(comes.to_owned() + "is of an authority that this machine does not know\n  hint: "), None),
        (
            "none",
            "refused somebody who connects: it shows no certificate\n  hint: ",
            Some("it asks for a certificate, and "),
        ),
        ("past", &(comes.to_owned() + "has expired\n  hint: "), Some(&*out_of_time)),
        ("future", &(comes.to_owned() + "is not valid yet\n  hint: "), Some(&*out_of_time)),
        ("right", "the link to machine `base` is up", Some("the link to machine `robot` is up")),
    ] {
        std::fs::create_dir_all(base.path("tls")).unwrap();
        match what {
            "past" => make_for_time(&folder, "base", PAST),
            "future" => make_for_time(&folder, "base", FUTURE),
            _ => assert!(make_certificates(&folder, &["base"], "localhost")),
        }
        hand_over(&robot, &base);
        if what == "none" {
            base.write("tls/base.json5", "{ transport: { link: { tls: { root_ca_certificate: 'ca.pem' } } } }");
        } else if what == "other" {
            for file in ["base.key", "base.pem"] {
                std::fs::copy(another_authority.join(file), base.path("tls").join(file)).unwrap();
            }
        }
        let mut base_run = start(&base, "base");
        robot_run.wait_for_text(at_robot);
        at_base.into_iter().for_each(|text| base_run.wait_for_text(text));
        if what == "right" {
            base_run.wait_until("tracks arrive", || newest(&base) > 0);
        } else {
            assert_eq!((base.lines("tracks.jsonl").len(), top_link(&base)["was_heard"].as_bool()), (0, Some(false)));
        }
        base_run.end();
    }
    robot_run.end();
}

/// The machines that connect detect a faulty certificate of the machine that listens.
#[test]
fn a_listening_machine_with_an_expired_certificate_is_refused_and_both_sides_report_it() {
    let endpoint = tls_loopback();
    let [robot, base] = live(&endpoint);
    let folder = robot.path("tls");
    if !make_certificates(&folder, &["robot", "base"], "localhost") {
        return;
    }
    make_for_time(&folder, "robot", ["20200101000000Z", "20200102000000Z"]);
    hand_over(&robot, &base);
    let mut runs = [start(&robot, "robot"), start(&base, "base")];
    runs[1].wait_for_text(&format!("refused the machine at `{endpoint}`: its certificate has expired\n  hint: "));
    runs[0].wait_for_text("somebody who connects refuses this machine: by the clock there its certificate has expired");
    drop(runs.map(Started::end));
}

#[test]
fn faults_of_the_machines_own_certificate_are_reported_before_the_run_and_do_not_stop_it() {
    let text = live_text(&tls_loopback());
    let robot = Playground::with_pipeline(&text);
    let folder = robot.path("tls");
    if !make_certificates(&folder, &["robot", "base"], "localhost") {
        return;
    }
    let validate = || robot.conicflow(&["validate", "--machine", "robot"]);
    let valid = validate().expect_code(0);
    assert!(!valid.stdout.contains("certificate"), "{}", valid.stdout);
    make_for_time(&folder, "robot", ["20200101000000Z", "20200102000000Z"]);
    let is_reported = |text: &str, kind: &str| {
        let parts = ["machine `robot`: the certificate in `", "robot.pem` has expired "];
        text.lines().any(|line| line.trim().starts_with(kind) && parts.iter().all(|part| line.contains(part)))
    };
    let warned = validate().expect_code(0);
    assert!(is_reported(&warned.stdout, "warning"), "{}", warned.stdout);
    let found = robot.conicflow(&["doctor", "--machine", "robot"]).expect_code(1);
    assert!(is_reported(&found.stdout, "problem"), "{}", found.stdout);
    // The run starts although the certificate has expired, because the clock of the machine may be corrected while it runs.
    let mut run = start(&robot, "robot");
    run.wait_until("it works", || robot.top()["stages"][0]["messages"].as_u64() > Some(10));
    let ended = run.end();
    assert!(is_reported(&ended.stderr, "warning"), "{}", ended.stderr);
    std::fs::copy(folder.join("base.key"), folder.join("robot.key")).unwrap();
    let mixed = validate().expect_code(0).stdout;
    assert!(mixed.contains("robot.key` is not the key of the certificate in `"), "{mixed}");
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

/// A machine with a valid certificate of the authority that reads and writes other machines' messages.
struct Guest {
    session: zenoh::Session,
    received: Arc<AtomicU64>,
    _subscribers: Vec<zenoh::pubsub::Subscriber<()>>,
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
        let received = Arc::new(AtomicU64::new(0));
        let listen = |key: &str| {
            let received = Arc::clone(&received);
            let count = move |_| {
                received.fetch_add(1, Ordering::Relaxed);
            };
            session.declare_subscriber(format!("conicflow/tracking/{key}")).callback(count).wait().unwrap()
        };
        let subscribers = ["robot/*", "@link/robot"].map(listen).into();
        Self { session, received, _subscribers: subscribers }
    }

    /// Sends heartbeats as the base, with another version.
    fn lie(&self) {
        self.session.put("conicflow/tracking/@link/base", b"CFLO\x63\x00".as_slice()).wait().unwrap();
    }
}

#[test]
fn a_machine_outside_the_access_list_can_neither_read_nor_write() {
    const EXAMPLE: &str = include_str!("../../examples/tls/access_control.json5");
    let endpoint = tls_loopback();
    let [robot, base] = live(&endpoint);
    let folder = robot.path("tls");
    if !make_certificates(&folder, &["robot", "base", "guest"], "localhost") {
        return;
    }
    // The keys contain an `@`, so the placeholder is another character.
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
            let has_read_and_written =
                || guest.received.load(Ordering::Relaxed) > 0 && robot_run.stderr().contains("version 99");
            newest(&base) > before + 30 && (listed || has_read_and_written())
        });
        let (received, noticed) = (guest.received.load(Ordering::Relaxed), robot_run.stderr().contains("version 99"));
        assert_eq!([received == 0, !noticed], [listed; 2], "{received} messages; {}", robot_run.stderr());
        drop([base_run, robot_run].map(Started::end));
    }
}
