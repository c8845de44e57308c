//! Attacks on runs: kills, stops and swaps of stages, launchers and bridges on one to three machines, runs that are ended or
//! killed and begun again, onlookers that come and die, messages that are forged from true ones. Each round is drawn from one
//! seed, which is printed with all that it does: `CONICFLOW_ATTACK_SEED=123 cargo test --test end_to_end -- attack --nocapture`
//! does that round again, and `CONICFLOW_ATTACK_ROUNDS=3000` as many others.
//!
//! Whatever happens: a run comes to its end, no message comes twice or out of order, with a lossless reader that is killed
//! nothing is lost, unless its writer was killed as well, what is missing is counted, exit code 1 says that something lossless
//! was lost and nothing else does, no process and no file stays behind, and a pipeline beside the run feels nothing. Where only
//! runs were begun again, the last one of the source comes whole from where its readers joined it.

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
/// No round lasts longer, unless it stands still: frames are few, and nobody is stopped for long.
const LONGEST: Duration = Duration::from_secs(120);
/// A machine that is begun again when the others have nothing left for it is asked to end after this time.
const ALONE: Duration = Duration::from_secs(10);
/// A minute on two busy cores.
const DEFAULT_ROUNDS: u64 = 16;
/// What is drawn with the first seed is different from what [`stress`](super::stress) does.
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

/// Listens to the link for a moment, and puts what was heard back onto it with a few bytes changed.
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

/// Starts what a round needs: its machines, and who listens to their link.
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

/// Does one round; what was found wrong.
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
    // On one machine the last run is as if no other had been before.
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

/// Waits for the end of all runs. A run that waits for a machine whose launcher is dead, or that has ended before it was begun
/// again, is asked to end; whether that was so.
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

/// Makes sure that no frame comes twice or out of order, but where the run that makes them was begun again.
fn expect_in_order(round: &Round, results: &[Vec<u64>], source_runs: usize) -> Result<(), String> {
    let steps_back = results.iter().flat_map(|life| life.windows(2)).filter(|pair| pair[0] >= pair[1]).count();
    let allowed = if round.has_link() { source_runs - 1 } else { 0 };
    if steps_back <= allowed { Ok(()) } else { Err(format!("twice or out of order: {results:?}")) }
}

/// Makes sure that what the source's last run has made has all come, but for what machines in between held when they were begun
/// again.
fn expect_no_gap(round: &Round, whole: Whole, sequences: &[u64]) -> Result<(), String> {
    let start = sequences.windows(2).rposition(|pair| pair[0] >= pair[1]).map_or(0, |index| index + 1);
    let newest = &sequences[start..];
    let has_start = whole == Whole::FromSomewhere || newest.first() == Some(&0);
    let has_end = newest.last().is_none_or(|&last| last + 1 == round.frames);
    let gaps = newest.windows(2).filter(|pair| pair[0] + 1 != pair[1]).count();
    let is_whole = has_start && has_end && gaps <= round.relays_begun_again();
    if is_whole { Ok(()) } else { Err(format!("a gap: {sequences:?}")) }
}

/// Makes sure that a run has ended well, or says what it has lost.
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

/// Makes sure that each edge has counted what it lost, and that the exit code says whether that was to be; how many.
fn expect_counted(round: &Round, ended: &Ended, lines: u64) -> Result<u64, String> {
    // A run that is told to end before its first stage has joined it has nothing to count.
    if ended.stages().is_empty() {
        let nothing_was_to_be = round.has(|blow| matches!(blow, Blow::End)) && lines == 0 && ended.code == Some(0);
        return if nothing_was_to_be { Ok(0) } else { Err(format!("no stage joined: {}", ended.stderr)) };
    }
    let (mut lost_in_all, mut lossless_lost) = (0, 0);
    for (topic, writer, reader) in TRACKING_TOPICS {
        let (sent, row) = (ended.stage(writer).messages, ended.input(topic, reader));
        // A stage that is killed when it has sent a message and not yet counted it makes and counts it again where it gets that
        // input again. One that wants the newest only gets another, and its next message has the same number; so does one whose
        // input was lost meanwhile, because what wrote it was killed as well.
        let gets_it_again = writer == "source" || round.is_lossless(writer) && lossless_lost == 0;
        let doubtful = if gets_it_again { 0 } else { round.kills_of(writer) };
        // One that wants the newest only does not know what was sent before it looked for the first time.
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
    // A source that is killed when it has sent a frame and not yet counted it, and the run ends, does not come back to count it.
    let doubtful = round.kills_of("source");
    if round.is_all_lossless() && (lines + lost_in_all).abs_diff(made) > doubtful {
        return Err(format!("{made} made, {lines} lines, {lost_in_all} lost: {}", ended.stderr));
    }
    Ok(lost_in_all)
}

/// Makes sure that what was lost between a stage and its lossless reader had a reason: both were killed, so that nobody was left
/// who had it, or the reader was killed twice over the same frame.
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
