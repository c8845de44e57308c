//! The phases in which a run ends, and the action that is due in each.

use std::time::{Duration, Instant};

/// An ending run is ended at once after this long without progress: no delivery, and no stage that ends or restarts. It exceeds
/// the five seconds for which a writer waits for readers before it ends.
pub(super) const DELIVERY_GRACE: Duration = Duration::from_secs(7);
/// Stages that were asked to end at once are killed after this time.
const KILL_GRACE: Duration = Duration::from_secs(5);

/// Phase of a run.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Phase {
    Running,
    /// The sources were stopped; `since` is the time of the last delivery.
    Delivering {
        delivered: u64,
        since: Instant,
    },
    /// All stages were asked to end at once.
    Stopping {
        since: Instant,
    },
    Killing,
}

/// Action that is due in a phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Due {
    Nothing,
    /// The run has reached its duration.
    StopSources,
    /// This much was delivered by now, more than before.
    WaitForMore(u64),
    /// Nothing was delivered for too long.
    EndStalled,
    KillAll,
}

impl Phase {
    /// The action due at the time `now` in a run that has gone on for `active_time` of its duration `limit`; `delivered` returns
    /// the progress of the delivery.
    pub(crate) fn due(
        self,
        now: Instant,
        active_time: Duration,
        limit: Option<Duration>,
        delivered: impl FnOnce() -> u64,
    ) -> Due {
        match self {
            Self::Running if limit.is_some_and(|limit| active_time > limit) => Due::StopSources,
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
        let due = |active_time: Duration, limit: Option<Duration>| {
            Phase::Running.due(Instant::now(), active_time, limit, || unreachable!("a run at work is not asked"))
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
