//! Finds out which stages of a stalled run wait for which, from the records of its stages.

use crate::clock::monotonic_ns;
use crate::plan::PlannedStage;
use crate::status::{Pausing, Status};
use conicflow_messages::Text;
use std::time::Duration;

/// Silence after which a stage counts as hanging; a waiting stage has ten heartbeats a second.
const SILENT: Duration = Duration::from_secs(2);

/// Describes what each unfinished stage waits for, in the order of the file; sources that do not wait are left out.
pub(crate) fn who_waits(stages: &[(&PlannedStage, &Status)]) -> Vec<String> {
    let now_ns = monotonic_ns();
    let over = |status: &Status| status.life().is_over();
    let alive = stages.iter().filter(|(_, status)| !over(status));
    alive.filter_map(|(planned, status)| reason_to_wait(planned, status, stages, now_ns)).collect()
}

/// Whether any stage waits for another one to take its messages.
pub(crate) fn is_held_up(stages: &[(&PlannedStage, &Status)]) -> bool {
    let is_over = |status: &Status| status.life().is_over();
    stages.iter().any(|(_, status)| status.waits_for != Text::default() && !is_over(status))
}

fn reason_to_wait(
    planned: &PlannedStage,
    status: &Status,
    stages: &[(&PlannedStage, &Status)],
    now_ns: u64,
) -> Option<String> {
    let name = &planned.name;
    let silent = Duration::from_nanos(now_ns.saturating_sub(status.alive_ns));
    if silent > SILENT {
        return Some(format!("`{name}` has given no sign of life for {:.0} s", silent.as_secs_f64()));
    }
    if status.waits_for != Text::default() {
        return Some(format!("`{name}` waits for `{}` to take its messages", status.waits_for));
    }
    if status.pausing() == Pausing::Stands {
        return Some(format!("`{name}` is paused"));
    }
    let input = planned.wiring.input.as_ref()?;
    let sent_by = |writer: &String| stages.iter().find(|(planned, _)| planned.name == *writer).map(|(_, own)| own.sent);
    let sent = input.writers.iter().map(sent_by).sum::<Option<u64>>();
    let [counts, ..] = &status.inputs;
    let arrived = counts.received.saturating_add(counts.dropped).saturating_add(counts.late);
    if sent.is_some_and(|sent| sent > arrived) {
        return Some(format!("`{name}` has messages to work on"));
    }
    Some(format!("`{name}` waits for a message of `{}`", input.writers.join("`, `")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::{Topic, Wiring};
    use crate::status::Life;

    fn stage(name: &str, reads_from: Option<&str>) -> PlannedStage {
        let topic = |writer: &str| Topic { writers: vec![writer.into()], ..Topic::default() };
        let wiring = Wiring { input: reads_from.map(topic), ..Wiring::default() };
        PlannedStage { name: name.into(), wiring, ..PlannedStage::default() }
    }

    fn record(sent: u64, received: u64, waits_for: &str) -> Box<Status> {
        let mut status = Box::<Status>::default();
        (status.sent, status.waits_for) = (sent, Text::new(waits_for));
        status.inputs[0].received = received;
        status.alive_ns = monotonic_ns();
        status.set_life(Life::Running);
        status
    }

    #[test]
    fn it_is_told_who_waits_for_whom() {
        let plans = [stage("a", None), stage("b", Some("a")), stage("c", Some("b")), stage("d", Some("c"))];
        let mut silent = record(7, 7, "");
        silent.alive_ns = silent.alive_ns.saturating_sub(5_000_000_000);
        let records = [record(12, 0, "b"), record(8, 9, ""), silent, record(0, 7, "")];
        let stages: Vec<_> = plans.iter().zip(records.iter().map(|record| &**record)).collect();
        let told = [
            "`a` waits for `b` to take its messages",
            "`b` has messages to work on",
            "`c` has given no sign of life for 5 s",
            "`d` waits for a message of `c`",
        ];
        assert_eq!(who_waits(&stages), told);
        assert!(is_held_up(&stages) && !is_held_up(&stages[1..]));
    }

    #[test]
    fn a_source_that_is_paused_is_not_held_up_and_said_to_be_paused() {
        let (plans, mut paused) = ([stage("a", None), stage("b", Some("a"))], record(12, 0, ""));
        paused.set_pausing(Pausing::Stands);
        let records = [paused, record(8, 12, "")];
        let stages: Vec<_> = plans.iter().zip(records.iter().map(|record| &**record)).collect();
        assert_eq!(who_waits(&stages), ["`a` is paused", "`b` waits for a message of `a`"]);
        assert!(!is_held_up(&stages));
    }

    #[test]
    fn who_is_over_waits_for_nobody() {
        let (plan, mut status) = (stage("a", None), record(12, 0, "b"));
        status.set_life(Life::Ended);
        assert_eq!(who_waits(&[(&plan, &status)]), [""; 0]);
        assert!(!is_held_up(&[(&plan, &status)]));
    }
}
