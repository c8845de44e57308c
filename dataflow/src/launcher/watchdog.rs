//! Distinguishes a stage that hangs from one that waits: a waiting stage beats ten times a second, and each step is a heartbeat,
//! too.

use std::time::{Duration, Instant};

/// A stage without a heartbeat for this long is reported, unless the file sets another time.
const REPORT_AFTER: Duration = Duration::from_secs(10);
/// Maximum time between two checks that counts as silence of the stage: in a longer one the launcher or the machine stood still,
/// too.
const LONGEST_CHECK_PERIOD: Duration = Duration::from_secs(1);

/// Heartbeat of one process as the launcher sees it.
#[derive(Debug)]
pub(crate) struct Watchdog {
    process: u32,
    sign: Option<u64>,
    silent: Duration,
    last_check: Instant,
    reported: bool,
}

/// Change found by a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum HangReport {
    /// The process has had no heartbeat for too long; holds the time since the last one.
    Hangs(Duration),
    /// The process has a heartbeat again; holds the time without one.
    Recovered(Duration),
}

impl Watchdog {
    /// Starts to watch a process that was just started, or has just taken over.
    pub(crate) fn new(process: u32, now: Instant) -> Self {
        Self { process, sign: None, silent: Duration::ZERO, last_check: now, reported: false }
    }

    /// Checks the last heartbeat (`sign`) in the record of `process`; `None` without a record. The process hangs after a silence
    /// of `limit`.
    pub(crate) fn check(
        &mut self,
        process: u32,
        sign: Option<u64>,
        limit: Option<Duration>,
        now: Instant,
    ) -> Option<HangReport> {
        if process != self.process {
            *self = Self::new(process, now);
        }
        let passed = now.duration_since(self.last_check).min(LONGEST_CHECK_PERIOD);
        self.last_check = now;
        if sign != self.sign {
            self.sign = sign;
            let silent = std::mem::take(&mut self.silent);
            return std::mem::take(&mut self.reported).then_some(HangReport::Recovered(silent));
        }
        self.silent += passed;
        let hangs = !self.reported && self.silent > limit.unwrap_or(REPORT_AFTER);
        self.reported |= hangs;
        hangs.then_some(HangReport::Hangs(self.silent))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHECK_PERIOD: Duration = Duration::from_millis(100);

    /// Runs checks with these heartbeats, a tenth of a second apart; returns the changes with the indices of the checks.
    fn reports(signs: impl IntoIterator<Item = Option<u64>>) -> Vec<(usize, HangReport)> {
        let begin = Instant::now();
        let mut watchdog = Watchdog::new(7, begin);
        let checks = signs.into_iter().enumerate();
        let reports = checks.filter_map(|(check, sign)| {
            let report = watchdog.check(7, sign, Some(Duration::from_secs(2)), begin + CHECK_PERIOD * check as u32);
            Some((check, report?))
        });
        reports.collect()
    }

    #[test]
    fn a_stage_hangs_when_its_last_sign_is_old_and_that_is_told_once() {
        let signs = (0..10).map(Some).chain([Some(10); 60]).chain([Some(11); 10]);
        let reports = reports(signs);
        let [(31, HangReport::Hangs(silent)), (70, HangReport::Recovered(_))] = reports[..] else {
            panic!("{reports:?}")
        };
        assert!((2.0..2.2).contains(&silent.as_secs_f64()), "{silent:?}");
    }

    #[test]
    fn a_stage_that_never_came_to_its_record_hangs_too() {
        let reports = reports([None; 30]);
        assert!(matches!(reports[..], [(21, HangReport::Hangs(_))]), "{reports:?}");
    }

    #[test]
    fn time_in_which_nobody_looked_does_not_count() {
        let begin = Instant::now();
        let mut watchdog = Watchdog::new(7, begin);
        let limit = Some(Duration::from_secs(2));
        assert_eq!(watchdog.check(7, Some(1), limit, begin), None);
        assert_eq!(watchdog.check(7, Some(1), limit, begin + Duration::from_secs(3600)), None);
    }

    #[test]
    fn another_process_begins_anew() {
        let begin = Instant::now();
        let mut watchdog = Watchdog::new(7, begin);
        let second = |count: u32| begin + Duration::from_secs(count.into());
        for count in 0..3 {
            assert_eq!(watchdog.check(7, None, Some(Duration::from_secs(3)), second(count)), None);
        }
        assert_eq!(watchdog.check(8, None, Some(Duration::from_secs(3)), second(4)), None);
        assert!(watchdog.check(8, None, Some(Duration::from_millis(500)), second(5)).is_some());
    }
}
