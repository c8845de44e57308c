use super::*;
use crate::edge_tests::edge;
use crate::wire::seal::secret;
use conicflow_dataflow::{LinkKey, Receiver};

/// The links of a bridge with one peer.
fn links_of(machine: &str, peer: &str, journal: Journal, secret: &LinkKey) -> Links {
    links_with(machine, peer, journal, secret, Vec::new())
}

/// The links of a bridge with one peer, with these outgoing edges.
fn links_with(machine: &str, peer: &str, journal: Journal, secret: &LinkKey, outgoing: Vec<Edge>) -> Links {
    let plan = BridgePlan { machine: machine.to_owned(), outgoing, ..BridgePlan::default() };
    let seal = Seal::new(Some(secret), journal.session());
    let links = Links::new(journal, seal, &plan);
    lock(&links.peers).insert(peer.to_owned(), Peer::default());
    links
}

fn robot(number: u64, secret: &LinkKey) -> Links {
    links_of("robot", "base", Journal::open(None, 7, number), secret)
}

fn base(number: u64, secret: &LinkKey) -> Links {
    links_of("base", "robot", Journal::open(None, 7, number), secret)
}

/// The next heartbeat of a bridge as it goes onto the link, with an acknowledgement for the machine `base`.
fn heartbeat_of(links: &Links) -> Vec<u8> {
    let ack = Ack { from: "base".to_owned(), topic: "objects".to_owned(), next: links.session, ..Ack::default() };
    let mut bytes_sent = Vec::new();
    links.send_heartbeat(&links.machine, News { acks: vec![ack], ..links.news() }, |bytes| bytes_sent = bytes);
    bytes_sent
}

fn receive_all(links: &Links, machine: &str, beats: &[Vec<u8>]) {
    beats.iter().for_each(|bytes| links.receive_heartbeat(machine, machine, bytes));
}

/// Exchanges heartbeats between two bridges; returns those of the robot.
fn exchange_heartbeats(robot: &Links, base: &Links) -> Vec<Vec<u8>> {
    let mut heartbeats = Vec::new();
    for _ in 0..3 {
        heartbeats.push(heartbeat_of(robot));
        receive_all(base, "robot", &heartbeats[heartbeats.len() - 1..]);
        receive_all(robot, "base", &[heartbeat_of(base)]);
    }
    heartbeats
}

/// The session of the robot that a base believes; checks that its acknowledgements are of that session, too.
fn believed(base: &Links) -> Option<u64> {
    let acknowledged = base.ack_of("robot", "objects").map(|ack| ack.next);
    let session = lock(&base.peers)["robot"].session;
    assert_eq!(acknowledged, session);
    assert!(session.is_none_or(|session| base.is_present("robot", session) == Ok(true)));
    session
}

#[test]
fn a_peer_is_believed_once_it_reports_this_bridge_and_sent_messages_once_it_believes_this_bridge() {
    let secret = secret();
    let (robot, base) = (robot(1, &secret), base(2, &secret));
    receive_all(&base, "robot", &[heartbeat_of(&robot)]);
    assert_eq!((believed(&base), base.owes_answer(), base.owes_answer()), (None, true, false));
    receive_all(&robot, "base", &[heartbeat_of(&base)]);
    assert_eq!(robot.is_present("base", 2), Ok(true));
    assert!(robot.owes_answer() && !robot.is_connected("base"), "the base would not take anything yet");
    let answer = heartbeat_of(&robot);
    assert!(robot.is_connected("base") && robot.round_trip("base").is_some());
    receive_all(&base, "robot", &[answer]);
    assert_eq!(believed(&base), Some(1));
}

#[test]
fn a_link_is_up_since_the_first_heartbeat_that_was_believed() {
    let secret = secret();
    let (robot, base) = (robot(1, &secret), base(2, &secret));
    let connected_since = || lock(&robot.peers)["base"].connected_since;
    assert_eq!((connected_since(), robot.check_peers()["base"].connected), (None, false));
    exchange_heartbeats(&robot, &base);
    let up = connected_since();
    exchange_heartbeats(&robot, &base);
    assert!(up.is_some() && connected_since() == up && robot.check_peers()["base"].connected);
}

#[test]
fn replayed_heartbeats_of_an_earlier_session_are_not_believed() {
    let secret = secret();
    let first_base = base(10, &secret);
    let first_robot = robot(1, &secret);
    let mut recorded = exchange_heartbeats(&first_robot, &first_base);
    assert_eq!(believed(&first_base), Some(1));
    let held_back = heartbeat_of(&first_robot);
    // The robot's clock is set back in between.
    for number in [7, 3] {
        let present = robot(number, &secret);
        recorded.extend(exchange_heartbeats(&present, &first_base));
        receive_all(&first_base, "robot", &recorded);
        assert_eq!(believed(&first_base), Some(number));
    }
    receive_all(&first_base, "robot", &[held_back]);
    assert_eq!(believed(&first_base), Some(3));
    assert_eq!(first_base.is_present("robot", 1), Err(OF_EARLIER_START));
    assert_eq!(first_base.is_present("robot", 7), Ok(false));
    let second_base = base(11, &secret);
    receive_all(&second_base, "robot", &recorded);
    assert_eq!(believed(&second_base), None, "nothing of that was said to this start of the base");
    exchange_heartbeats(&robot(4, &secret), &second_base);
    assert_eq!(believed(&second_base), Some(4));
}

#[test]
fn an_edge_is_finished_when_both_ends_know_it_and_stays_so_after_restarts() {
    let (secret, robot_folder, base_folder) = (secret(), tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let start = |machine: &str, peer: &str, folder: &tempfile::TempDir, run: u64, number: u64| {
        let journal = Journal::open(Some(folder.path()), run, number);
        links_of(machine, peer, journal, &secret)
    };
    let robot = |number| start("robot", "base", &robot_folder, 7, number);
    let base = |number| start("base", "robot", &base_folder, 8, number);
    let (first_robot, first_base) = (robot(1), base(2));
    first_base.note_finished("robot", "objects");
    assert_eq!(first_base.is_finished("robot", "objects"), (false, false), "of which run is not known");
    exchange_heartbeats(&first_robot, &first_base);
    first_base.note_finished("robot", "objects");
    assert_eq!(first_base.is_finished("robot", "objects"), (true, false));
    assert!(!first_robot.has_finished("base", "objects"));
    // The base is restarted before its report arrives.
    let second_base = base(3);
    assert_eq!(second_base.is_finished("robot", "objects"), (true, false));
    exchange_heartbeats(&first_robot, &second_base);
    assert!(first_robot.has_finished("base", "objects") && !first_robot.has_finished("base", "tracks"));
    // The robot is restarted before it has reported that it knows.
    let second_robot = robot(4);
    assert!(second_robot.has_finished("base", "objects"));
    exchange_heartbeats(&second_robot, &second_base);
    assert_eq!(second_base.is_finished("robot", "objects"), (true, true));
    assert_eq!(second_base.is_finished("robot", "tracks"), (false, false));
    // Another run of the base wants all further messages.
    let next_base = start("base", "robot", &base_folder, 10, 6);
    fall_silent(&second_robot, "base");
    exchange_heartbeats(&second_robot, &next_base);
    assert!(!second_robot.has_finished("base", "objects"));
    next_base.note_finished("robot", "objects");
    exchange_heartbeats(&second_robot, &next_base);
    assert_eq!(next_base.is_finished("robot", "objects"), (true, false), "the robot knows it of the run before alone");
    assert!(second_robot.has_finished("base", "objects"));
    exchange_heartbeats(&second_robot, &next_base);
    assert_eq!(next_base.is_finished("robot", "objects"), (true, true));
    // Another run of the robot sends its messages anew.
    let other_run = start("robot", "base", &robot_folder, 9, 5);
    fall_silent(&second_base, "robot");
    exchange_heartbeats(&other_run, &second_base);
    assert!(!other_run.has_finished("base", "objects"));
}

/// Sets the time when a peer was last heard to long ago.
fn fall_silent(links: &Links, peer: &str) {
    lock(&links.peers).get_mut(peer).unwrap().heard_at = Instant::now().checked_sub(DISCONNECTED_AFTER);
}

/// Which double runs a bridge has reported.
fn rivals(links: &Links, peer: &str) -> [bool; 2] {
    [Rivals::There, Rivals::Here].map(|which| lock(&links.peers)[peer].reported_rivals.contains(&which))
}

#[test]
fn of_two_runs_of_a_machine_the_first_counts_while_it_is_heard_and_both_are_reported() {
    let secret = secret();
    let robot = |run, session| links_of("robot", "base", Journal::open(None, run, session), &secret);
    let (first, second, base) = (robot(7, 3), robot(8, 2), base(1, &secret));
    exchange_heartbeats(&first, &base);
    for _ in 0..3 {
        exchange_heartbeats(&second, &base);
        exchange_heartbeats(&first, &base);
        assert_eq!((believed(&base), base.is_present("robot", 2)), (Some(3), Ok(false)));
    }
    assert_eq!(rivals(&base, "robot"), [true, false]);
    // Each reports the other only if it was heard long after itself.
    assert_eq!((rivals(&first, "base"), rivals(&second, "base")), ([false; 2], [false; 2]));
    for robot in [&first, &second] {
        let mut peers = lock(&robot.peers);
        let proved_ns = &mut peers.get_mut("base").unwrap().proved_ns[1];
        *proved_ns = proved_ns.saturating_sub(2 * REPORT_MISSING_AFTER.as_nanos() as u64);
    }
    exchange_heartbeats(&second, &base);
    exchange_heartbeats(&first, &base);
    assert_eq!((rivals(&first, "base"), rivals(&second, "base")), ([false, true], [false, true]));
    fall_silent(&base, "robot");
    exchange_heartbeats(&second, &base);
    assert_eq!(believed(&base), Some(2), "the second takes its place");
}

#[test]
fn a_restarted_run_is_not_taken_for_a_second_run() {
    let secret = secret();
    let robot = |run, session| links_of("robot", "base", Journal::open(None, run, session), &secret);
    let (first, second, base) = (robot(7, 1), robot(8, 2), base(1, &secret));
    let mut heartbeats = exchange_heartbeats(&first, &base);
    heartbeats.push(heartbeat_of(&first));
    exchange_heartbeats(&second, &base);
    assert_eq!(believed(&base), Some(1), "the first was heard just now");
    receive_all(&base, "robot", &heartbeats);
    fall_silent(&base, "robot");
    exchange_heartbeats(&second, &base);
    receive_all(&base, "robot", &heartbeats);
    assert_eq!((believed(&base), rivals(&base, "robot"), rivals(&second, "base")), (Some(2), [false; 2], [false; 2]));
}

/// A heartbeat of a bridge after a change.
fn forged(links: &Links, change: impl FnOnce(&mut Heartbeat)) -> Vec<u8> {
    let mut heartbeat = links.heartbeat(links.news());
    change(&mut heartbeat);
    let mut bytes = encode_note(&heartbeat).unwrap();
    links.seal.sign(&links.machine, &mut bytes);
    bytes
}

#[test]
fn a_forged_heartbeat_from_the_future_does_not_block_genuine_ones() {
    let secret = secret();
    let sent_ns = |links: &Links, peer: &str| lock(&links.peers)[peer].samples[0].sent_ns;
    for both in [false, true] {
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        exchange_heartbeats(&robot, &base);
        let yet_to_come = |links: &Links| forged(links, |heartbeat| heartbeat.sent_ns = u64::MAX);
        receive_all(&base, "robot", &[yet_to_come(&robot)]);
        assert_eq!(sent_ns(&base, "robot"), u64::MAX);
        if both {
            receive_all(&robot, "base", &[yet_to_come(&base)]);
            // These heartbeats report the forged ones.
            let heartbeats = [heartbeat_of(&robot), heartbeat_of(&base)];
            receive_all(&base, "robot", &heartbeats[..1]);
            receive_all(&robot, "base", &heartbeats[1..]);
        }
        let proved = [(&base, "robot"), (&robot, "base")].map(|(links, peer)| {
            fall_silent(links, peer);
            lock(&links.peers)[peer].answered_ns
        });
        exchange_heartbeats(&robot, &base);
        for ((links, peer), before) in [(&base, "robot"), (&robot, "base")].into_iter().zip(proved) {
            assert!(sent_ns(links, peer) < u64::MAX, "{peer}, both: {both}");
            assert!(lock(&links.peers)[peer].answered_ns > before, "{peer} is believed, both: {both}");
        }
    }
}

#[test]
fn a_heartbeat_that_reports_one_that_was_never_sent_is_refused() {
    let secret = secret();
    let (robot, base) = (robot(1, &secret), base(2, &secret));
    exchange_heartbeats(&robot, &base);
    let ahead = forged(&robot, |heartbeat| heartbeat.samples[0].sent_ns = u64::MAX);
    receive_all(&base, "robot", &[ahead]);
    assert_eq!(lock(&base.peers)["robot"].refused.texts().len(), 1);
    exchange_heartbeats(&self::robot(3, &secret), &base);
    assert_eq!(believed(&base), Some(3), "who is started anew proves itself all the same");
}

#[test]
fn an_edge_that_a_third_party_declared_finished_goes_on() {
    let secret = secret();
    let (robot, base) = (robot(1, &secret), base(2, &secret));
    exchange_heartbeats(&robot, &base);
    let finished = FinishedEdge { from: "robot".into(), to: "base".into(), topic: "objects".into(), run: 7 };
    receive_all(&robot, "base", &[forged(&base, |heartbeat| heartbeat.news.finished.push(finished))]);
    assert!(robot.has_finished("base", "objects"));
    exchange_heartbeats(&robot, &base);
    assert!(!robot.has_finished("base", "objects"));
}

#[test]
fn a_machine_heard_by_an_earlier_process_counts_as_heard_at_the_start_of_this_one() {
    let (secret, folder) = (secret(), tempfile::tempdir().unwrap());
    let robot = |number| links_of("robot", "base", Journal::open(Some(folder.path()), 7, number), &secret);
    let first = robot(1);
    assert_eq!(first.last_heard("base"), None);
    exchange_heartbeats(&first, &base(2, &secret));
    let second = robot(3);
    assert_eq!(second.last_heard("base"), Some(second.started));
    assert!(!second.is_connected("base"));
}

#[test]
fn silence_counts_from_the_start_of_waiting_or_for_a_machine_never_heard_from_the_start_of_the_process() {
    let secret = secret();
    let (mut robot, base, hour) = (robot(1, &secret), base(2, &secret), Duration::from_secs(3600));
    robot.started = Instant::now().checked_sub(hour).unwrap();
    let is_silent = |since| robot.silence("base", since) >= hour;
    let now = Instant::now();
    assert!(is_silent(now), "who has waited for it in vain waits no longer");
    exchange_heartbeats(&robot, &base);
    assert!(!is_silent(now));
    assert!(!is_silent(robot.started));
}

#[test]
fn replayed_heartbeats_do_not_displace_the_present_session_from_the_reports() {
    let secret = secret();
    let base = base(100, &secret);
    let recorded: Vec<_> =
        (1..8).flat_map(|number| exchange_heartbeats(&robot(number, &secret), &self::base(99, &secret))).collect();
    exchange_heartbeats(&robot(8, &secret), &base);
    receive_all(&base, "robot", &recorded);
    let samples = &lock(&base.peers)["robot"].samples;
    assert!(samples.len() == SESSIONS && samples.iter().any(|sample| sample.session == 8), "{samples:?}");
}

#[test]
fn a_machine_with_another_pipeline_file_is_distinguished_from_one_with_the_same() {
    let secret = secret();
    let to_base = |delivery| edge(delivery, "reader");
    let to_arm =
        Edge { to: vec![Receiver { machine: "arm".into(), delivery: Delivery::Latest }], ..to_base(Delivery::Latest) };
    let start = |machine: &str, peer: &str, edges: &[Edge]| {
        links_with(machine, peer, Journal::open(None, 7, 1), &secret, edges.to_vec())
    };
    let base = start("base", "robot", &[to_base(Delivery::Lossless)]);
    let unlike = |edges: &[Edge]| {
        let robot = start("robot", "base", edges);
        let base = start("base", "robot", &[to_base(Delivery::Lossless)]);
        exchange_heartbeats(&robot, &base);
        lock(&base.peers)["robot"].unlike.iter().map(|route| route.what.clone()).collect::<Vec<_>>()
    };
    assert!(base.routes[0].what.ends_with("of writer, lossless"), "{}", base.routes[0].what);
    assert!(unlike(&[to_base(Delivery::Lossless), to_arm]).is_empty(), "what goes elsewhere is no concern of this one");
    let other = unlike(&[to_base(Delivery::Latest)]);
    assert!(other.len() == 1 && other[0].ends_with("of writer, latest"), "{other:?}");
}

#[test]
fn the_news_holds_the_last_acknowledgement_of_each_edge() {
    let links = base(1, &secret());
    let ack = |topic: &str, next| Ack { from: "robot".to_owned(), topic: topic.to_owned(), next, ..Ack::default() };
    [ack("objects", 1), ack("tracks", 1), ack("objects", 2)].into_iter().for_each(|ack| links.note_ack(ack));
    assert_eq!(links.news().acks, [ack("objects", 2), ack("tracks", 1)]);
}

#[test]
fn the_quickest_exchange_of_heartbeats_gives_round_trip_and_clock_offset() {
    let secret = secret();
    let (robot, base) = (robot(1, &secret), base(2, &secret));
    assert_eq!((robot.round_trip("base"), robot.clock_offset("base")), (None, None));
    exchange_heartbeats(&robot, &base);
    let mut clock = Clock::default();
    clock.add([100, 1110, 1150, 160]);
    lock(&robot.peers).get_mut("base").unwrap().clock = clock;
    assert_eq!((robot.round_trip("base"), robot.clock_offset("base")), (Some(Duration::from_nanos(20)), Some(1000)));
}

#[test]
fn a_machine_is_connected_until_it_has_been_silent_for_long() {
    let heard_at = Instant::now();
    let peer = Peer { heard_at: Some(heard_at), ..Peer::default() };
    assert!(
        is_connected(&peer, heard_at + DISCONNECTED_AFTER - Duration::from_nanos(1))
            && !is_connected(&peer, heard_at + DISCONNECTED_AFTER)
    );
}

#[test]
fn a_machine_that_does_not_appear_in_time_is_reported_missing_unless_it_was_heard_or_refused() {
    let is_missed = |waited: Duration, peer: Peer| {
        let mut links = robot(1, &secret());
        links.started = Instant::now().checked_sub(waited).unwrap();
        lock(&links.peers).insert("base".to_owned(), peer);
        links.check_peers();
        lock(&links.peers)["base"].missed
    };
    assert!(is_missed(2 * REPORT_MISSING_AFTER, Peer::default()) && !is_missed(Duration::ZERO, Peer::default()));
    assert!(!is_missed(2 * REPORT_MISSING_AFTER, Peer { heard_at: Some(Instant::now()), ..Peer::default() }));
    let mut refused = Peer::default();
    refuse("base", &mut refused, &WireError::WrongCode);
    assert!(!is_missed(2 * REPORT_MISSING_AFTER, refused));
}

#[test]
fn a_machine_is_shown_as_refused_as_long_as_messages_in_its_name_are() {
    let links = robot(1, &secret());
    let is_refused = || links.check_peers()["base"].refused;
    assert!(!is_refused());
    refuse("base", lock(&links.peers).get_mut("base").unwrap(), &WireError::WrongCode);
    assert!(is_refused());
    lock(&links.peers).get_mut("base").unwrap().refused_at = Instant::now().checked_sub(DISCONNECTED_AFTER);
    assert!(!is_refused());
}

#[test]
fn a_machine_with_another_message_layout_is_refused() {
    let secret = secret();
    let (robot, base) = (robot(1, &secret), base(2, &secret));
    let theirs = "conicflow.Header.v1".to_owned();
    let heartbeat = Heartbeat { layouts: theirs.clone(), ..robot.heartbeat(News::default()) };
    let mut bytes = encode_note(&heartbeat).unwrap();
    robot.seal.sign("robot", &mut bytes);
    receive_all(&base, "robot", &[bytes]);
    let peer = &lock(&base.peers)["robot"];
    let reason = WireError::Layout { ours: layouts(), theirs }.to_string();
    assert_eq!((peer.refused.texts(), peer.samples.len()), (&BTreeSet::from([reason]), 0));
}

#[test]
fn a_forged_heartbeat_changes_nothing_and_is_reported() {
    let secrets = [secret(), secret()];
    let base = base(10, &secrets[0]);
    let present = robot(1, &secrets[0]);
    let heartbeats = exchange_heartbeats(&present, &base);
    let sent_ns = || lock(&base.peers)["robot"].samples[0].sent_ns;
    let before = sent_ns();
    let next = heartbeat_of(&present);
    for at in [6, 20, 45, next.len() - 1] {
        let mut changed = next.clone();
        changed[at] ^= 1;
        receive_all(&base, "robot", &[changed]);
    }
    receive_all(&base, "robot", &[next[..next.len() - 1].to_vec()]);
    base.receive_heartbeat("robot", "base", &next);
    let (stranger, other_base) = (robot(2, &secrets[1]), self::base(10, &secrets[1]));
    receive_all(&base, "robot", &exchange_heartbeats(&stranger, &other_base));
    receive_all(&base, "robot", &heartbeats);
    assert_eq!((believed(&base), sent_ns()), (Some(1), before));
    let refused = lock(&base.peers)["robot"].refused.texts().clone();
    assert_eq!(refused, BTreeSet::from([WireError::WrongCode.to_string()]));
    receive_all(&base, "robot", &[next]);
    assert_ne!(sent_ns(), before, "the true one passes");
}
