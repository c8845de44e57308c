//! Logging of a run's processes to standard error, at a level or by a filter.

use conicflow_messages::plain;
use std::fmt::{self, Debug, Display};
use std::io::{self, IsTerminal, Stderr, Write, stderr};
use std::time::{Duration, Instant};
use tracing::field::Field;
use tracing_subscriber::field::MakeExt;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::format::{Writer, debug_fn};
use tracing_subscriber::layer::{Identity, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, Registry};

/// Environment variable: level or filter of the log.
pub const LOG: &str = "CONICFLOW_LOG";
/// Environment variable: if set and not empty, each line begins with the time in UTC.
const LOG_TIME: &str = "CONICFLOW_LOG_TIME";
/// Default level.
pub const DEFAULT_LOG: &str = "info";

/// Clears the line of a terminal before a line is logged, as the run's progress may be shown there.
pub const CLEAR_LINE: &str = "\r\x1b[K";

/// Checks the level (error, warn, info, debug or trace) or the filter, such as `conicflow_dataflow=debug`.
///
/// # Errors
/// The text is neither a level nor a filter. A single word has to be a level: `tracing` would take any other word as the only
/// target to log.
pub fn log_filter(text: &str) -> Result<String, String> {
    parts(text).try_for_each(|part| part.map(drop)).map(|()| text.to_owned())
}

/// Parses a filter into targets and their levels; a level alone has the target "", which matches all. `EnvFilter`, which also
/// knows spans and values, would bring a library of regular expressions that takes as long to build as the detection.
fn parts(filter: &str) -> impl Iterator<Item = Result<(&str, LevelFilter), String>> {
    filter.split(',').map(str::trim).filter(|part| !part.is_empty()).map(|part| {
        let (target, word) = part.split_once('=').unwrap_or(("", part));
        let level = word.parse().ok().filter(|_| !word.is_empty());
        let fault = || format!("`{word}` is no level\n  hint: error, warn, info, debug or trace");
        Ok((target, level.ok_or_else(fault)?))
    })
}

/// Makes this process log what the filter lets through, unless it has a logger already.
pub fn log_to_standard_error(filter: &str) {
    // A layer without a filter of its own would let all levels pass, also for `tracing::enabled`.
    log_beside(filter, Identity::new().with_filter(LevelFilter::OFF));
}

/// Logs as [`log_to_standard_error`] does, and adds a layer with a filter of its own.
pub fn log_beside(filter: &str, ear: impl Layer<Registry> + Send + Sync) {
    // The filter of a program from outside may not have been checked before.
    let told = |error| writeln!(stderr(), "in the filter of the log, {error}").ok();
    let targets: Targets = parts(filter).filter_map(|part| part.map_err(told).ok()).collect();
    let is_terminal = stderr().is_terminal();
    let writer = move || Lines { place: stderr(), begin: if is_terminal { CLEAR_LINE } else { "" } };
    let layer = tracing_subscriber::fmt::layer().with_writer(writer).with_target(false);
    // A closed log is not a fault of the run.
    let layer =
        layer.with_ansi(is_terminal).log_internal_errors(false).fmt_fields(debug_fn(write_field).delimited(" "));
    let is_timed = std::env::var_os(LOG_TIME).is_some_and(|value| !value.is_empty());
    let layer = if is_timed { layer.boxed() } else { layer.without_time().boxed() };
    tracing_subscriber::registry().with(ear).with(layer.with_filter(targets)).try_init().ok();
}

/// Writes each log line at the beginning of a line of the terminal.
struct Lines {
    place: Stderr,
    begin: &'static str,
}

impl Write for Lines {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        // In one write, as other processes write to the same terminal.
        self.place.write_all(&[self.begin.as_bytes(), text].concat())?;
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.place.flush()
    }
}

/// Writes a field without characters that a terminal would interpret.
fn write_field(log: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> fmt::Result {
    let text = plain(&format!("{value:?}"));
    if field.name() == "message" { log.write_str(&text) } else { write!(log, "{field}={text}") }
}

/// The text of an error without characters that a terminal would interpret.
pub fn error_text(error: impl Display) -> String {
    plain(&format!("error: {error}"))
}

/// Minimum interval between two warnings of the same kind.
const WARNING_INTERVAL: Duration = Duration::from_secs(1);

/// Limits the rate of a warning that may occur with each message.
#[derive(Clone, Debug, Default)]
pub struct ThrottledWarning {
    told: Option<Instant>,
    untold: u64,
}

impl ThrottledWarning {
    /// Logs the warning, or counts it for the next one where the last was less than a second ago.
    pub fn warn(&mut self, what: impl Display) {
        if self.told.is_some_and(|told| told.elapsed() < WARNING_INTERVAL) {
            self.untold += 1;
            return;
        }
        self.told = Some(Instant::now());
        match std::mem::take(&mut self.untold) {
            0 => tracing::warn!("{what}"),
            untold => tracing::warn!("{what} (and {untold} times something of the kind before)"),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::io::{Read, Seek};
    use std::sync::{Arc, LazyLock};
    use std::thread;
    use tracing::subscriber::NoSubscriber;
    use tracing::{Dispatch, Level};

    /// A second dispatcher. With only one, `tracing` asks the current thread's dispatcher when a call site is first reached, and
    /// then disables the site for all threads.
    static SECOND: LazyLock<Dispatch> = LazyLock::new(|| Dispatch::new(NoSubscriber::new()));

    /// Runs `act` and returns what this thread logs meanwhile at this level or above.
    pub(crate) fn logged(least: Level, act: impl FnOnce()) -> String {
        LazyLock::force(&SECOND);
        let (mut log, mut text) = (tempfile::tempfile().unwrap(), String::new());
        let writer = Arc::new(log.try_clone().unwrap());
        let subscriber = tracing_subscriber::fmt().with_writer(writer).with_ansi(false).with_max_level(least).finish();
        tracing::subscriber::with_default(subscriber, act);
        log.rewind().unwrap();
        log.read_to_string(&mut text).unwrap();
        text
    }

    #[test]
    fn what_another_thread_tells_first_is_logged_of_this_one() {
        let tell = || tracing::info!("told");
        let log = logged(Level::INFO, || {
            thread::spawn(tell).join().unwrap();
            tell();
        });
        assert_eq!(log.matches("told").count(), 1, "{log}");
    }

    #[test]
    fn a_filter_names_levels_and_targets_and_nothing_else() {
        let told = |filter| parts(filter).collect::<Result<Vec<_>, _>>();
        assert_eq!(told("info"), Ok(vec![("", LevelFilter::INFO)]));
        assert_eq!(told("WARN, other=debug,"), Ok(vec![("", LevelFilter::WARN), ("other", LevelFilter::DEBUG)]));
        assert_eq!(told(""), Ok(vec![]), "nothing is logged");
        for (filter, word) in [("debgu", "debgu"), ("info,debgu", "debgu"), ("other=debgu", "debgu"), ("other=", "")] {
            let fault = format!("`{word}` is no level\n  hint: error, warn, info, debug or trace");
            assert_eq!(log_filter(filter), Err(fault), "{filter}");
        }
    }

    #[test]
    fn the_last_level_of_the_longest_target_counts() {
        let targets: Targets = parts("other=info,warn,other=error,other::net=off").map(Result::unwrap).collect();
        for (target, most) in [("conicflow", Level::WARN), ("other::api", Level::ERROR)] {
            assert!(targets.would_enable(target, &most), "{target}");
            assert!(!targets.would_enable(target, &Level::INFO), "{target}");
        }
        assert!(!targets.would_enable("other::net", &Level::ERROR));
    }
}
