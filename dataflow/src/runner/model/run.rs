//! A state of the modelled run: its launcher, its stages with their processes, and the possible next events.

use super::memory::{Fault, Memory, STAGES, on};
use super::process::{At, Exit, Process};
use crate::status::Life;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Parameters of a check of the model.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Trial {
    /// Number of frames of the source.
    pub(super) frames: u64,
    /// Maximum number of kills.
    pub(super) kills: u8,
    /// Maximum number of swaps of the middle stage.
    pub(super) swaps: u8,
    /// Whether the user may end the run.
    pub(super) is_interrupted: bool,
    pub(super) fault: Fault,
}

/// An event of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Event {
    /// The active process of a stage makes a step.
    Step(usize),
    /// The successor of the middle stage makes a step.
    StepComing,
    /// The launcher checks a stage: `Supervised::look`.
    Look(usize),
    /// The launcher advances the swap: `Swap::advance`.
    AdvanceSwap,
    /// Any process cleans up dead processes: `clean_dead_nodes`.
    ClearAway,
    Kill(usize),
    KillComing,
    /// The user ends the run: `Launcher::stop_sources`.
    Interrupt,
    /// The user replaces the middle stage: `Swap::begin`.
    Swap,
}

/// Models `child::State`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum State {
    Running,
    Waiting,
    Done,
}

/// A stage as the launcher sees it.
#[derive(Clone, Debug, Hash)]
struct Stage {
    state: State,
    process: Option<Process>,
    exit: Exit,
    starts: u8,
}

/// Models `swap::Step`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Swap {
    None,
    Preparing,
    Leaving,
    Beginning,
}

/// Index of the stage that is swapped.
const MIDDLE: usize = 1;

/// A state of the run; the checker takes two for the same if their fingerprints are equal.
#[derive(Clone, Debug)]
pub(super) struct Run {
    pub(super) memory: Memory,
    stages: [Stage; 3],
    swap: Swap,
    coming: Option<Process>,
    is_ending: bool,
    /// Number of kills of each stage.
    pub(super) kills: [u8; 3],
    swaps: u8,
    /// Hash of all other fields.
    fingerprint: u64,
}

impl PartialEq for Run {
    fn eq(&self, other: &Self) -> bool {
        self.fingerprint == other.fingerprint
    }
}

impl Hash for Run {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.fingerprint.hash(state);
    }
}

impl Run {
    pub(super) fn new(trial: &Trial, newest_first: bool) -> Self {
        let memory = Memory { fault: trial.fault, newest_first, ..Memory::default() };
        let stage = |stage| Stage {
            state: State::Running,
            process: Some(Process::spawn(stage, 0, false)),
            exit: Exit::InOrder,
            starts: 1,
        };
        let stages = [0, 1, 2].map(stage);
        let (swap, coming, is_ending, kills, swaps) = (Swap::None, None, false, [0; 3], 0);
        Self { memory, stages, swap, coming, is_ending, kills, swaps, fingerprint: 0 }.with_fingerprint()
    }

    fn with_fingerprint(self) -> Self {
        let Self { memory, stages, swap, coming, is_ending, kills, swaps, fingerprint: _ } = &self;
        let mut hasher = DefaultHasher::new();
        (memory, stages, swap, coming, is_ending, kills, swaps).hash(&mut hasher);
        Self { fingerprint: hasher.finish(), ..self }
    }

    /// Whether the launcher has ended.
    pub(super) fn is_over(&self) -> bool {
        self.stages.iter().all(|stage| stage.state == State::Done)
    }

    /// Appends the possible next events, including some that change nothing.
    pub(super) fn events(&self, trial: &Trial, events: &mut Vec<Event>) {
        if self.is_over() {
            return;
        }
        let processes = (0..STAGES.len()).filter(|stage| self.stages[*stage].process.is_some());
        events.extend(processes.clone().map(Event::Step));
        let is_to_be_looked_at = |stage: &usize| match self.stages[*stage].state {
            State::Running => self.stages[*stage].process.is_none(),
            State::Waiting => true,
            State::Done => false,
        };
        events.extend((0..STAGES.len()).filter(is_to_be_looked_at).map(Event::Look));
        events.extend(self.coming.iter().map(|_| Event::StepComing));
        events.extend(Some(Event::AdvanceSwap).filter(|_| self.swap != Swap::None));
        events.extend(Some(Event::ClearAway).filter(|_| self.memory.has_dead()));
        if self.kills.iter().sum::<u8>() < trial.kills {
            events.extend(processes.map(Event::Kill));
            events.extend(self.coming.iter().map(|_| Event::KillComing));
        }
        if trial.is_interrupted && !self.is_ending {
            events.push(Event::Interrupt);
        }
        if self.swaps < trial.swaps {
            events.push(Event::Swap);
        }
    }

    /// The state after an event; `None` if it changes nothing.
    pub(super) fn after(&self, event: Event, trial: &Trial) -> Option<Self> {
        let mut next = self.clone();
        match event {
            Event::Step(stage) => next.step(stage, trial),
            Event::StepComing => next.step_coming(trial),
            Event::Look(stage) => next.look(stage),
            Event::AdvanceSwap => next.advance_swap(),
            Event::ClearAway => next.memory.clear_away(),
            Event::Kill(stage) => next.kill(stage),
            Event::KillComing => next.kill_coming(),
            Event::Interrupt => next.interrupt(),
            Event::Swap => next.begin_swap(),
        }
        let next = next.with_fingerprint();
        (next != *self).then_some(next)
    }

    fn step(&mut self, stage: usize, trial: &Trial) {
        let own = &mut self.stages[stage];
        let Some(process) = &mut own.process else { return };
        let Some(exit) = on(&mut self.memory, || process.step(trial.frames)) else { return };
        self.memory.close(stage, process.number);
        (own.process, own.exit) = (None, exit);
    }

    fn step_coming(&mut self, trial: &Trial) {
        let Some(process) = &mut self.coming else { return };
        on(&mut self.memory, || process.step(trial.frames));
    }

    fn kill(&mut self, stage: usize) {
        let own = &mut self.stages[stage];
        let Some(process) = own.process.take() else { return };
        own.exit = Exit::Killed;
        self.kills[stage] += 1;
        self.memory.abandon(stage, process.number);
    }

    fn kill_coming(&mut self) {
        let Some(process) = self.coming.take() else { return };
        self.kills[MIDDLE] += 1;
        self.memory.abandon(MIDDLE, process.number);
    }

    fn life(&mut self, stage: usize, life: Life) {
        self.memory.records[stage].life = life;
    }

    /// Whether a stage that ended is not restarted: `Supervised::look` in `Phase::Delivering`.
    const fn stays_away(&self, stage: usize) -> bool {
        self.is_ending && stage == 0
    }

    /// Models `Supervised::look` and `Supervised::ended`.
    fn look(&mut self, stage: usize) {
        let decides_about_exit = matches!(self.swap, Swap::Leaving | Swap::Beginning);
        if decides_about_exit && stage == MIDDLE {
            return;
        }
        let own = &self.stages[stage];
        match own.state {
            State::Running if own.process.is_none() => {
                let has_ended = own.exit == Exit::InOrder && self.memory.records[stage].life == Life::Ended;
                if has_ended {
                    self.stages[stage].state = State::Done;
                } else if self.stays_away(stage) {
                    self.stay_away(stage);
                } else {
                    self.stages[stage].state = State::Waiting;
                }
            }
            State::Waiting if self.stays_away(stage) => self.stay_away(stage),
            // `Launcher::replace` runs between two checks, and gives the swap up.
            State::Waiting if stage == MIDDLE && self.swap == Swap::Preparing => {}
            State::Waiting => {
                let own = &mut self.stages[stage];
                own.process = Some(Process::spawn(stage, own.starts, false));
                own.starts += 1;
                own.state = State::Running;
            }
            State::Running | State::Done => {}
        }
    }

    fn stay_away(&mut self, stage: usize) {
        self.stages[stage].state = State::Done;
        self.life(stage, Life::Gone);
    }

    /// Sends SIGINT to the source; a process that has no handler yet dies.
    fn interrupt(&mut self) {
        self.is_ending = true;
        let source = &mut self.stages[0];
        match &mut source.process {
            Some(process) if process.at == At::Spawned => (source.process, source.exit) = (None, Exit::Killed),
            Some(process) => process.is_asked_to_end = true,
            None => {}
        }
    }

    /// Whether the record says that the process of the middle stage is, or was, at work: `swap::is_at_work`.
    fn is_at_work(&self) -> bool {
        let (own, record) = (&self.stages[MIDDLE], &self.memory.records[MIDDLE]);
        let process = own.process.as_ref().map_or(own.starts - 1, |process| process.number);
        record.process == process && record.life != Life::Starting
    }

    /// Models `Swap::begin`.
    fn begin_swap(&mut self) {
        let own = &mut self.stages[MIDDLE];
        if self.swap != Swap::None || own.state != State::Running || self.is_ending {
            return;
        }
        if self.is_at_work() {
            let own = &mut self.stages[MIDDLE];
            (self.memory.first_to_receive, self.memory.last_worked_on) = (None, None);
            self.coming = Some(Process::spawn(MIDDLE, own.starts, true));
            own.starts += 1;
            self.swaps += 1;
            self.swap = Swap::Preparing;
        }
    }

    /// Models `Swap::advance`.
    fn advance_swap(&mut self) {
        let is_at_work = self.is_at_work();
        let at_work = &mut self.stages[MIDDLE];
        match self.swap {
            Swap::None => {}
            Swap::Preparing => match &self.coming {
                Some(coming) if !self.is_ending && at_work.state == State::Running => {
                    if coming.at == At::Ready {
                        at_work.process.iter_mut().for_each(|process| process.is_asked_to_leave = true);
                        self.swap = Swap::Leaving;
                    }
                }
                _ => self.dismiss(),
            },
            Swap::Leaving if at_work.process.is_some() => {}
            Swap::Leaving => {
                let has_ended = at_work.exit == Exit::InOrder && self.memory.records[MIDDLE].life == Life::Ended;
                if has_ended {
                    self.dismiss();
                } else {
                    self.take_place();
                }
            }
            Swap::Beginning if is_at_work => self.swap = Swap::None,
            Swap::Beginning if at_work.process.is_some() => {}
            Swap::Beginning => {
                at_work.state = State::Waiting;
                self.swap = Swap::None;
            }
        }
    }

    /// Models `Successor::dismiss`.
    fn dismiss(&mut self) {
        if let Some(coming) = self.coming.take() {
            self.memory.close(MIDDLE, coming.number);
        }
        self.swap = Swap::None;
    }

    /// Models `swap::take_place`.
    fn take_place(&mut self) {
        let own = &mut self.stages[MIDDLE];
        own.process = self.coming.take();
        own.exit = Exit::Killed;
        own.process.iter_mut().for_each(|process| process.at = At::HasTurn);
        self.swap = Swap::Beginning;
    }
}
