//! Attacks on runs on one to three machines. They kill, stop and swap stages, kill launchers and bridges, end or kill runs and
//! start them again, start and kill onlookers, and send forged copies of genuine messages. The seed of a round decides what
//! happens; each round prints its seed and its actions. `CONICFLOW_ATTACK_SEED=123 cargo test --test end_to_end -- attack
//! --nocapture` repeats a round, `CONICFLOW_ATTACK_ROUNDS=3000` does as many others.
//!
//! In each round the following has to hold. The run ends. No message comes twice or out of order. If a lossless reader is killed,
//! nothing is lost, unless its writer was killed, too. Each missing message is counted. The exit code is 1 if a lossless edge has
//! lost something, and 0 otherwise. No process and no file is left. A pipeline beside the run is not affected. If only whole runs
//! were started again, all frames of the last run of the source arrive from the one on at which its readers joined.

mod machine;
mod round;

use super::routers::session;
use super::support::{CHECK_PERIOD, Ended, TRACKING_TOPICS, wait_until};
use machine::Machine;
use round::{Blow, Round, Whole};
use rustix::process::Signal;
use std::any::Any;
use std::fmt::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};
use zenoh::Wait;
use zenoh::sample::Locality;

const ROUNDS: &str = "CONICFLOW_ATTACK_ROUNDS";
const SEED: &str = "CONICFLOW_ATTACK_SEED";
/// Maximum time of a round. A round that takes longer is stalled: it has few frames, and no process is stopped for long.
const LONGEST: Duration = Duration::from_secs(120);
/// Time after the end of the first machine's run. If a run was started again and others still run after this time, they are
/// interrupted, because they may wait for a machine that has ended.
const ALONE: Duration = Duration::from_secs(10);
/// Number of rounds, which take a minute on two busy cores.
const DEFAULT_ROUNDS: u64 = 16;
/// The first seed differs from those of [`stress`](super::stress), so that other actions are drawn.
const FIRST_SEED: u64 = 1000;

fn strike(blow: Blow, machines: &mut [Machine], link: Option<&zenoh::Session>) -> Result<(), String> {
    match blow {
        Blow::Kill(victim) => machines[victim.machine].kill(victim),
        Blow::Stop(victim, milliseconds, then) => machines[victim.machine].stop(victim, milliseconds, then),
        Blow::Swap(victim) => machines[victim.machine].swap(victim),
        Blow::LookOn(topic, milliseconds) => {
            machines.iter_mut().last().into_iter().for_each(|machine| machine.look_on(topic, milliseconds));
        }
        Blow::KillLauncher(machine) => machines[machine].kill_launcher(),
        Blow::End => machines.iter().for_each(|machine| machine.signal(Signal::INT)),
        Blow::Again(machine, by) => {
            let ended = machines[machine].begin_again(by);
            return if by == Signal::KILL { Ok(()) } else { expect_explained(&ended) };
        }
        Blow::Forge => link.into_iter().for_each(forge),
    }
    Ok(())
}

/// Listens to the link for a moment, and sends the received messages again with a few bytes changed.
fn forge(link: &zenoh::Session) {
    let subscriber = link.declare_subscriber("conicflow/**").allowed_origin(Locality::Remote);
    let (subscriber, until) = (subscriber.wait().unwrap(), Instant::now() + Duration::from_millis(300));
    let mut random = fastrand::Rng::with_seed(7);
    while Instant::now() < until
        && let Ok(Some(sample)) = subscriber.recv_deadline(until)
    {
        let mut bytes = sample.payload().to_bytes().into_owned();
        for _ in 0..random.usize(1..4) {
            let index = random.usize(..bytes.len().clamp(1, 60));
            if let Some(byte) = bytes.get_mut(index) {
                *byte = random.u8(..);
            }
        }
        link.put(sample.key_expr(), bytes).wait().unwrap();
    }
}

fn eavesdropper(endpoint: &str) -> zenoh::Session {
    let listens = || std::net::TcpStream::connect(&endpoint[4..]).is_ok();
    wait_until("the link is there", listens);
    session("peer", &[("connect/endpoints", &format!("[\"{endpoint}\"]")), ("connect/timeout_ms", "5000")])
}

/// Starts the machines of a round, and the session that listens to their link.
fn begin(round: &Round) -> (Vec<Machine>, Option<zenoh::Session>) {
    let endpoints = round.endpoints();
    let text = round.text(&endpoints);
    let mut machines: Vec<_> = round.commands().into_iter().map(|command| Machine::start(&text, command)).collect();
    if round.has_neighbor {
        machines[0].start_neighbor();
    }
    let link = endpoints.first().filter(|_| round.has(|blow| matches!(blow, Blow::Forge)));
    (machines, link.map(|endpoint| eavesdropper(endpoint)))
}

/// Does one round. An error says what was wrong.
fn attack(mut round: Round) -> Result<String, String> {
    let (mut machines, link) = begin(&round);
    let last = machines.len() - 1;
    let (begun, blows) = (Instant::now(), std::mem::take(&mut round.blows));
    for (after, blow) in blows {
        while machines[last].lines() < after && machines.iter_mut().all(Machine::is_running) {
            machines.iter_mut().for_each(Machine::settle);
            expect_no_standstill(begun, &machines)?;
            std::thread::sleep(CHECK_PERIOD);
        }
        let begins_again = matches!(blow, Blow::Again(..));
        if begins_again && !machines.iter_mut().all(Machine::is_running) {
            continue;
        }
        strike(blow, &mut machines, link.as_ref())?;
        round.blows.push((after, blow));
    }
    machines.iter_mut().for_each(Machine::wake_all);
    let was_interrupted = finish(&round, begun, &mut machines)?;
    let (results, lives) =
        (machines[last].sequences(), machines.iter().map(|machine| machine.lives).collect::<Vec<_>>());
    let ended = machines.into_iter().map(Machine::end).collect::<Result<Vec<_>, _>>()?;
    expect_in_order(&round, &results, lives[0])?;
    let sequences = results.last().map_or(&[][..], Vec::as_slice);
    let outcome = format!("{} lines, runs {lives:?}", sequences.len());
    if was_interrupted {
        return Ok(format!("cut off, {outcome}"));
    }
    if round.has_link() {
        ended.iter().try_for_each(expect_explained)?;
        round.whole_from().map_or(Ok(()), |whole| expect_no_gap(&round, whole, sequences))?;
        return Ok(outcome);
    }
    // With one machine, only the last run counts.
    round.forget_former_runs();
    let lost = expect_counted(&round, &ended[0], sequences.len() as u64)?;
    Ok(format!("{outcome}, {lost} lost"))
}

fn expect_no_standstill(begun: Instant, machines: &[Machine]) -> Result<(), String> {
    if begun.elapsed() < LONGEST {
        return Ok(());
    }
    let logs: Vec<_> = machines.iter().map(Machine::stderr).collect();
    Err(format!("it stands still: {logs:?}"))
}

/// Waits until all runs have ended. A run that waits for a machine whose launcher is dead, or that ended before it was started
/// again, is interrupted. Returns whether a run was interrupted or a launcher was killed.
fn finish(round: &Round, begun: Instant, machines: &mut [Machine]) -> Result<bool, String> {
    let was_cut = round.has(|blow| matches!(blow, Blow::KillLauncher(_)));
    let was_begun_again = round.has(|blow| matches!(blow, Blow::Again(..)));
    let (mut first_ended, mut was_interrupted) = (None, false);
    while machines.iter_mut().any(Machine::is_running) {
        let some_ended = !machines.iter_mut().all(Machine::is_running);
        let since: Instant = *first_ended.get_or_insert_with(Instant::now);
        if !some_ended {
            first_ended = None;
        }
        let is_alone = was_begun_again && some_ended && since.elapsed() > ALONE;
        if (was_cut || is_alone) && !was_interrupted {
            machines.iter().for_each(|machine| machine.signal(Signal::INT));
            was_interrupted = true;
        }
        machines.iter_mut().for_each(Machine::settle);
        expect_no_standstill(begun, machines)?;
        std::thread::sleep(CHECK_PERIOD);
    }
    Ok(was_interrupted || was_cut)
}

/// Checks that no frame comes twice or out of order, unless the run of the source was started again.
fn expect_in_order(round: &Round, results: &[Vec<u64>], source_runs: usize) -> Result<(), String> {
    let steps_back = results.iter().flat_map(|life| life.windows(2)).filter(|pair| pair[0] >= pair[1]).count();
    let allowed = if round.has_link() { source_runs - 1 } else { 0 };
    if steps_back <= allowed { Ok(()) } else { Err(format!("twice or out of order: {results:?}")) }
}

/// Checks that all frames of the source's last run have arrived, except those that machines in between held when they were
/// started again.
fn expect_no_gap(round: &Round, whole: Whole, sequences: &[u64]) -> Result<(), String> {
    let start = sequences.windows(2).rposition(|pair| pair[0] >= pair[1]).map_or(0, |index| index + 1);
    let newest = &sequences[start..];
    let has_start = whole == Whole::FromSomewhere || newest.first() == Some(&0);
    let has_end = newest.last().is_none_or(|&last| last + 1 == round.frames);
    let gaps = newest.windows(2).filter(|pair| pair[0] + 1 != pair[1]).count();
    let is_whole = has_start && has_end && gaps <= round.relays_begun_again();
    if is_whole { Ok(()) } else { Err(format!("a gap: {sequences:?}")) }
}

/// Checks that a run has ended with exit code 0, or says what it has lost.
fn expect_explained(ended: &Ended) -> Result<(), String> {
    let is_explained = match ended.code {
        Some(0) => true,
        Some(1) => {
            ended.stderr.contains(" messages of the lossless topic `") || ended.stderr.contains("not complete: ")
        }
        _ => false,
    };
    if is_explained { Ok(()) } else { Err(format!("exit code {:?}: {}", ended.code, ended.stderr)) }
}

/// Checks that each edge has counted its lost messages, and that the exit code agrees with them. Returns the number of lost
/// messages.
fn expect_counted(round: &Round, ended: &Ended, lines: u64) -> Result<u64, String> {
    // A run that is interrupted before its first stage has joined has no counts.
    if ended.stages().is_empty() {
        let nothing_was_to_be = round.has(|blow| matches!(blow, Blow::End)) && lines == 0 && ended.code == Some(0);
        return if nothing_was_to_be { Ok(0) } else { Err(format!("no stage joined: {}", ended.stderr)) };
    }
    let (mut lost_in_all, mut lossless_lost) = (0, 0);
    for (topic, writer, reader) in TRACKING_TOPICS {
        let (sent, row) = (ended.stage(writer).messages, ended.input(topic, reader));
        // A stage may be killed after it has sent a message and before it has counted it. If it gets the same input again, it
        // sends and counts the message again. An input with `latest` gets a newer one instead, and the next message has the same
        // number. The same happens if the input is lost because its writer was killed, too.
        let gets_it_again = writer == "source" || round.is_lossless(writer) && lossless_lost == 0;
        let doubtful = if gets_it_again { 0 } else { round.kills_of(writer) };
        // A reader with `latest` does not know of messages that were sent before it joined.
        let counted = row.received + row.dropped;
        if counted > sent + doubtful || (counted < sent && round.is_lossless(reader)) {
            return Err(format!("`{writer}` sent {sent}, `{reader}` has {row:?}: {}", ended.stderr));
        }
        lost_in_all += row.dropped;
        if round.is_lossless(reader) && row.dropped > 0 {
            lossless_lost += row.dropped;
            expect_reason(round, [writer, reader], ended)?;
        }
    }
    let expected = i32::from(lossless_lost > 0);
    let made = ended.stage("source").messages;
    if ended.code != Some(expected) {
        return Err(format!("exit code {:?}, {lossless_lost} lossless messages lost: {}", ended.code, ended.stderr));
    }
    // A source that is killed after it has sent a frame and before it has counted it does not restart if the run ends.
    let doubtful = round.kills_of("source");
    if round.is_all_lossless() && (lines + lost_in_all).abs_diff(made) > doubtful {
        return Err(format!("{made} made, {lines} lines, {lost_in_all} lost: {}", ended.stderr));
    }
    Ok(lost_in_all)
}

/// Checks that there is a reason for each message that was lost before a lossless reader: either both stages were killed, so that
/// no process had the message, or the reader was killed twice while it processed the same frame.
fn expect_reason(round: &Round, [writer, reader]: [&str; 2], ended: &Ended) -> Result<(), String> {
    let left_out = ended.stderr.contains(&format!("stage `{reader}` leaves out frame "));
    let both_died = round.kills_of(writer) > 0 && round.kills_of(reader) > 0;
    if both_died || (left_out && round.kills_of(reader) > 1) {
        return Ok(());
    }
    Err(format!("`{reader}` lost messages of `{writer}`, which lives: {}", ended.stderr))
}

#[test]
fn attacks_lose_nothing_uncounted_and_leave_nothing_behind() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let (first, rounds) = match number(SEED) {
        Some(seed) => (seed, number(ROUNDS).unwrap_or(1)),
        None => (FIRST_SEED, number(ROUNDS).unwrap_or(DEFAULT_ROUNDS)),
    };
    let mut wrong = String::new();
    for seed in first..first + rounds {
        let round = Round::draw(seed);
        let drawn = format!("{round:?}");
        println!("{SEED}={seed} {drawn}");
        let attacked = catch_unwind(AssertUnwindSafe(|| attack(round)));
        let text = |panic: Box<dyn Any + Send>| panic.downcast_ref::<String>().cloned().unwrap_or_default();
        match attacked.unwrap_or_else(|panic| Err(text(panic))) {
            Ok(outcome) => println!("  {outcome}"),
            Err(found) => {
                println!("  WRONG: {found}");
                writeln!(wrong, "{SEED}={seed}: {found}\n{drawn}").unwrap();
            }
        }
    }
    assert_eq!(wrong, "");
}
