//! The phases in which a run comes to its end, and what is due in each.

use std::time::{Duration, Instant};

/// An ending run in which nothing is delivered any more, and no stage ends or is started anew, for this long is ended at once. A
/// writer waits five seconds for readers that may still come, before it ends.
pub(super) const DELIVERY_GRACE: Duration = Duration::from_secs(7);
/// Stages that were told to end at once are killed after this time.
const KILL_GRACE: Duration = Duration::from_secs(5);

/// How hard the run presses for its end.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Phase {
    Running,
    /// The sources were stopped; something was delivered last at that time.
    Delivering {
        delivered: u64,
        since: Instant,
    },
    /// All stages were told to end at once.
    Stopping {
        since: Instant,
    },
    Killing,
}

/// What is due in a phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Due {
    Nothing,
    /// The run has lasted as long as it was to.
    StopSources,
    /// So much is delivered by now, which is more than before.
    WaitForMore(u64),
    /// Nothing was delivered for too long.
    EndStalled,
    KillAll,
}

impl Phase {
    /// What is due at the time `now` in a run that has gone on for `went_on` and is to go on for `limit`; `delivered` tells how
    /// far the delivery is.
    pub(crate) fn due(
        self,
        now: Instant,
        went_on: Duration,
        limit: Option<Duration>,
        delivered: impl FnOnce() -> u64,
    ) -> Due {
        match self {
            Self::Running if limit.is_some_and(|limit| went_on > limit) => Due::StopSources,
            Self::Delivering { delivered: before, since } => match delivered() {
                more if more > before => Due::WaitForMore(more),
                _ if now.duration_since(since) > DELIVERY_GRACE => Due::EndStalled,
                _ => Due::Nothing,
            },
            Self::Stopping { since } if now.duration_since(since) > KILL_GRACE => Due::KillAll,
            Self::Running | Self::Stopping { .. } | Self::Killing => Due::Nothing,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOMENT: Duration = Duration::from_millis(1);

    #[test]
    fn a_run_lasts_as_long_as_it_was_asked_to_and_without_an_end_where_nobody_asked() {
        let limit = Duration::from_secs(10);
        let due = |went_on: Duration, limit: Option<Duration>| {
            Phase::Running.due(Instant::now(), went_on, limit, || unreachable!("a run at work is not asked"))
        };
        assert_eq!(due(limit, Some(limit)), Due::Nothing);
        assert_eq!(due(limit + MOMENT, Some(limit)), Due::StopSources);
        assert_eq!(due(Duration::MAX, None), Due::Nothing);
    }

    #[test]
    fn a_delivery_may_take_any_time_unless_nothing_is_delivered_for_seven_seconds() {
        let since = Instant::now();
        let due = |after: Duration, delivered: u64| {
            let phase = Phase::Delivering { delivered: 5, since };
            phase.due(since + after, Duration::MAX, Some(Duration::ZERO), || delivered)
        };
        let grace = Duration::from_secs(7);
        assert_eq!([due(MOMENT, 5), due(grace, 5), due(grace, 4)], [Due::Nothing; 3]);
        assert_eq!(due(grace + MOMENT, 5), Due::EndStalled);
        assert_eq!(due(MOMENT, 6), Due::WaitForMore(6));
        assert_eq!(due(2 * grace, 6), Due::WaitForMore(6), "it came late, but it came");
    }

    #[test]
    fn stages_have_five_seconds_to_end_at_once_before_they_are_killed() {
        let since = Instant::now();
        let due = |phase: Phase, after: Duration| phase.due(since + after, Duration::MAX, Some(Duration::ZERO), || 0);
        let grace = Duration::from_secs(5);
        assert_eq!(due(Phase::Stopping { since }, grace), Due::Nothing);
        assert_eq!(due(Phase::Stopping { since }, grace + MOMENT), Due::KillAll);
        assert_eq!(due(Phase::Killing, 2 * grace), Due::Nothing, "they are killed already");
    }
}
