//! Kills processes at random moments: after each kill the run continues or has ended, and it leaves no files or processes.
//! `CONICFLOW_STRESS_ROUNDS=300 cargo test --test end_to_end -- stress --nocapture` does 300 rounds.

use crate::processes::{files_below, files_in_shared_memory, shared_prefix, stages_of, wait_for_lines};
use crate::support::{Playground, Started, TRACKING, TRACKING_STAGES, signal, wait_until};
use rustix::process::Signal;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::Duration;

const ROUNDS: &str = "CONICFLOW_STRESS_ROUNDS";
const DEFAULT_ROUNDS: usize = 16;

/// The moment of a kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Moment {
    Start,
    AtWork,
    Swap,
    End,
}

/// The processes that are killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Victims {
    Stage,
    TwoStages,
    Launcher,
    All,
}

const MOMENTS: [Moment; 4] = [Moment::Start, Moment::AtWork, Moment::Swap, Moment::End];
const VICTIMS: [Victims; 4] = [Victims::Stage, Victims::TwoStages, Victims::Launcher, Victims::All];

/// Files that the runs of the playground have left in shared memory and in the runtime folder, except lock files.
pub fn files(playground: &Playground, prefix: &str) -> BTreeSet<String> {
    let below = files_below(playground.runtime()).into_iter().map(|path| path.display().to_string());
    files_in_shared_memory(prefix).into_iter().chain(below.filter(|path| !path.ends_with("lock"))).collect()
}

/// Prefix of the names of all shared memory of the playground's runs.
pub fn prefix(playground: &Playground) -> String {
    let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
    wait_for_lines(&mut run, playground);
    let prefix = shared_prefix(playground);
    run.end();
    prefix
}

fn sleep_up_to(random: &mut fastrand::Rng, milliseconds: u64) {
    std::thread::sleep(Duration::from_millis(random.u64(0..=milliseconds)));
}

/// Starts a run and waits for this moment. Returns the run, and the swap if one is under way.
fn come_to(moment: Moment, playground: &Playground, random: &mut fastrand::Rng) -> (Started, Option<Started>) {
    let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
    if moment == Moment::Start {
        sleep_up_to(random, 300);
        return (run, None);
    }
    wait_for_lines(&mut run, playground);
    let swap = (moment == Moment::Swap)
        .then(|| playground.start(&["swap", *random.choice(&TRACKING_STAGES[1..]).as_ref().unwrap()]));
    if moment == Moment::End {
        signal(run.id(), Signal::INT);
    }
    sleep_up_to(random, if moment == Moment::End { 30 } else { 150 });
    (run, swap)
}

fn kill(victims: Victims, run: &Started, random: &mut fastrand::Rng) {
    let stages: Vec<u32> = stages_of(run.id()).into_values().collect();
    let count = match victims {
        Victims::Stage => 1,
        Victims::TwoStages => 2,
        Victims::Launcher => 0,
        Victims::All => stages.len(),
    };
    if victims == Victims::All && random.bool() {
        signal(run.id(), Signal::KILL);
    }
    random.choose_multiple(&stages, count).into_iter().for_each(|process| signal(*process, Signal::KILL));
    if matches!(victims, Victims::Launcher | Victims::All) {
        signal(run.id(), Signal::KILL);
    }
}

/// Does one kill, and panics if anything is wrong after it.
fn round(moment: Moment, victims: Victims, playground: &Playground, random: &mut fastrand::Rng) {
    fs::remove_file(playground.path("tracks.jsonl")).ok();
    let (mut run, swap) = come_to(moment, playground, random);
    kill(victims, &run, random);
    let goes_on = matches!(victims, Victims::Stage | Victims::TwoStages) && moment != Moment::End;
    if goes_on {
        wait_for_lines(&mut run, playground);
        signal(run.id(), Signal::INT);
    }
    let ended = run.wait();
    if goes_on {
        // If a stage and the one after it are killed at the same time, messages between them are lost.
        let ended = if victims == Victims::Stage { ended.expect_code(0) } else { ended.expect_survived() };
        let sequences = playground.sequences("tracks.jsonl");
        assert!(sequences.is_sorted(), "frames went back: {}", ended.stderr);
        let made = ended.stage("source").messages;
        assert!(victims != Victims::Stage || sequences.into_iter().eq(0..made), "{}", ended.stderr);
    }
    swap.map(Started::wait);
    wait_until("all processes are gone", || playground.processes().is_empty());
    let next = playground.conicflow(&["run", "--frames", "3", "--set", "json.path=next.jsonl"]).expect_code(0);
    assert_eq!(playground.sequences("next.jsonl"), [0, 1, 2], "{}", next.stderr);
    assert_eq!(playground.processes(), [0; 0], "the run is over, but not for these");
}

#[test]
fn kills_at_random_moments_leave_the_machine_as_it_was() {
    let rounds = std::env::var(ROUNDS).map_or(DEFAULT_ROUNDS, |text| text.parse().unwrap());
    let playground = Playground::with_pipeline(TRACKING);
    let prefix = prefix(&playground);
    let (before, mut random, mut seen) = (files(&playground, &prefix), fastrand::Rng::with_seed(1), BTreeMap::new());
    assert!(before.iter().all(|path| !path.starts_with(&prefix)), "{before:?}");
    for index in 0..rounds {
        let (moment, victims) = (random.choice(MOMENTS).unwrap(), random.choice(VICTIMS).unwrap());
        println!("round {index}: {victims:?} at {moment:?}");
        round(moment, victims, &playground, &mut random);
        let after: Vec<_> = files(&playground, &prefix).difference(&before).cloned().collect();
        assert_eq!(after, [""; 0], "left behind by {victims:?} at {moment:?}");
        *seen.entry((moment, victims)).or_insert(0) += 1;
    }
    println!("{rounds} rounds, nothing left behind: {seen:?}");
}
