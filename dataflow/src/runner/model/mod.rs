//! A model of the protocol between the launcher, the stages' processes and their topics, which `stateright` explores in every
//! possible order of events. It has a source, a stage and a sink, all lossless. Processes are killed between any two steps and
//! restarted, the stage is replaced, and the run is asked to end.
//!
//! Messages are taken and sent by the real [`InputPort`](super::input_port::InputPort) and
//! [`OutputPort`](super::output_port::OutputPort), over [topics](memory) that model iceoryx2. The [steps](process) of a process
//! and those of the [launcher](run) are rewritten from the functions that they name, because those block. There is no time: no
//! wait has a timeout. A state without a possible event that is not the end of the run is therefore a run that stalls, or goes on
//! only after a timeout.

mod memory;
mod process;
mod run;

use memory::Fault;
use run::{Event, Run, Trial};
use stateright::{Checker, HasDiscoveries, Model, Property};
use std::collections::BTreeSet;

impl Model for Trial {
    type State = Run;
    type Action = Event;

    fn init_states(&self) -> Vec<Run> {
        // The order matters only if a topic has two successive writers that were not cleaned up in between.
        let orders: &[bool] = if self.swaps > 0 { &[false, true] } else { &[false] };
        orders.iter().map(|newest_first| Run::new(self, *newest_first)).collect()
    }

    fn actions(&self, run: &Run, events: &mut Vec<Event>) {
        run.events(self, events);
    }

    fn next_state(&self, run: &Run, event: Event) -> Option<Run> {
        run.after(event, self)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("the run comes to its end", |trial: &Self, run: &Run| {
                let mut events = Vec::new();
                run.events(trial, &mut events);
                run.is_over() || events.into_iter().any(|event| run.after(event, trial).is_some())
            }),
            Property::always("messages are worked on in order, and again only by another process", |_, run: &Run| {
                // Messages that a stage sent before its second death may have been read, and their numbers are used again.
                run.memory.left_out > 0 || works_in_order(run)
            }),
            Property::always("writers keep what is not finished", |_, run: &Run| {
                run.memory.topics.iter().all(|topic| topic.keeps_all())
            }),
            Property::always("there is room for all that is sent", |_, run: &Run| !run.memory.has_overflown),
            Property::always("what is lost is counted, and nothing else", |_, run: &Run| {
                // Messages may have come although their sender died before it recorded them.
                let may_have_come = run.memory.left_out > 0 || killed_stages(run) > 1;
                let is_reported = |topic| match may_have_come {
                    false => lost(run, topic) == counted(run, topic),
                    true => lost(run, topic) <= counted(run, topic),
                };
                !run.is_over() || [0, 1].into_iter().all(is_reported)
            }),
            Property::always("nothing is lost where one stage alone was killed", |_, run: &Run| {
                let is_excepted = killed_stages(run) > 1 || run.memory.left_out > 0;
                !run.is_over() || is_excepted || [0, 1].into_iter().all(|topic| lost(run, topic) == 0)
            }),
            Property::sometimes("the run ends", |_, run: &Run| run.is_over()),
        ]
    }
}

fn works_in_order(run: &Run) -> bool {
    let readers = [1, 2];
    run.memory.topics.iter().zip(readers).all(|(topic, reader)| {
        let repeated = topic.worked_on.windows(2).filter(|pair| pair[0] == pair[1]).count();
        topic.worked_on.is_sorted() && repeated <= usize::from(run.kills[reader])
    })
}

/// Number of messages that were sent into a topic, by the record of its writer, and not processed.
fn lost(run: &Run, topic: usize) -> u64 {
    let worked_on: BTreeSet<_> = run.memory.topics[topic].worked_on.iter().collect();
    (0..run.memory.records[topic].sent).filter(|number| !worked_on.contains(number)).count() as u64
}

/// Number of messages that the reader has counted as lost; if its last process did not receive the end, the number that
/// `Summary::lost_by` returns.
fn counted(run: &Run, topic: usize) -> u64 {
    let (sent, counts) = (run.memory.records[topic].sent, &run.memory.records[topic + 1].counts);
    let never_came = if run.memory.topics[topic].is_end_heard { 0 } else { sent };
    counts.dropped.max(never_came.saturating_sub(counts.received + counts.late))
}

fn killed_stages(run: &Run) -> usize {
    run.kills.iter().filter(|kills| **kills > 0).count()
}

/// Explores all states of a trial, and prints a counterexample for each property that does not hold. Returns these properties,
/// and the number of states.
fn broken(trial: Trial) -> (Vec<&'static str>, usize) {
    let begin = std::time::Instant::now();
    let checker = trial.checker().threads(2).finish_when(HasDiscoveries::AnyFailures).spawn_bfs().join();
    let states = checker.unique_state_count();
    println!("{trial:?}: {states} states in {:.1} s", begin.elapsed().as_secs_f64());
    let mut broken = Vec::new();
    for (name, path) in checker.discoveries() {
        if name != "the run ends" {
            println!("not so: {name}\n  {:?}\n  {:?}", path.clone().into_actions(), path.last_state());
            broken.push(name);
        }
    }
    assert!(checker.discovery("the run ends").is_some() || !broken.is_empty(), "no run comes to its end");
    (broken, states)
}

#[test]
fn no_order_of_events_loses_anything_or_stands_still() {
    let trial = Trial { frames: 3, ..Trial::default() };
    for (trial, floor) in [
        (Trial { kills: 1, is_interrupted: true, ..trial }, 50_000),
        (Trial { frames: 2, swaps: 1, ..trial }, 5_000),
        (Trial { frames: 1, kills: 2, ..trial }, 90_000),
        (Trial { frames: 1, kills: 1, swaps: 1, ..trial }, 20_000),
    ] {
        expect_to_hold(trial, floor);
    }
}

/// Explores all orders of events in larger trials, which take minutes.
#[test]
#[ignore = "takes minutes"]
fn no_longer_order_of_events_loses_anything_or_stands_still() {
    let trial = Trial { frames: 2, is_interrupted: true, ..Trial::default() };
    expect_to_hold(Trial { frames: 4, kills: 1, ..trial }, 100_000);
    expect_to_hold(Trial { kills: 1, swaps: 1, ..trial }, 100_000);
    expect_to_hold(Trial { kills: 2, ..trial }, 250_000);
}

fn expect_to_hold(trial: Trial, floor: usize) {
    let (broken, states) = broken(trial);
    assert!(broken.is_empty(), "{broken:?}: {trial:?}");
    assert!(states > floor, "{states} states are too few: {trial:?}");
}

#[test]
fn what_the_protocol_stands_on_cannot_be_left_out() {
    for (fault, frames, kills) in [
        (Fault::NeverAcknowledges, 3, 0),
        (Fault::AcknowledgesFirst, 2, 1),
        (Fault::EndWithoutNumber, 1, 2),
        (Fault::KeepsNothing, 1, 1),
        (Fault::GoesOnUnseen, 1, 1),
        (Fault::ForgetsRecord, 2, 1),
    ] {
        let trial = Trial { frames, kills, ..Trial::default() };
        let (broken, _) = broken(Trial { fault, ..trial });
        assert!(!broken.is_empty(), "{fault:?} is not found out");
    }
}
