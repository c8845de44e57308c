//! What the processes of a run log, and where: to standard error, as a level or a filter says.

use conicflow_messages::plain;
use std::fmt::{self, Debug, Display};
use std::io::{self, IsTerminal, Stderr, Write, stderr};
use std::time::{Duration, Instant};
use tracing::field::Field;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::field::MakeExt;
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::fmt::format::{Writer, debug_fn};
use tracing_subscriber::util::SubscriberInitExt;

/// Environment variable: what is logged, as a level or a filter.
pub const LOG: &str = "CONICFLOW_LOG";
/// What is logged where nothing is said.
pub const DEFAULT_LOG: &str = "info";

/// What a line on a terminal begins with: the progress of the run may stand there.
pub const CLEAR_LINE: &str = "\r\x1b[K";

/// A level (error, warn, info, debug or trace), or a filter such as `conicflow_dataflow=debug`.
///
/// # Errors
/// It is neither: a single word has to be a level, as else it would count as the name of what alone is logged.
pub fn log_filter(text: &str) -> Result<String, String> {
    let is_named = |part: &str| part.contains(['=', '[', ']', '}']);
    let wrong = text.split(',').map(str::trim).find(|part| !is_named(part) && part.parse::<LevelFilter>().is_err());
    match (wrong, EnvFilter::try_new(text)) {
        (Some(word), _) => Err(format!("`{word}` is no level\n  hint: error, warn, info, debug or trace")),
        (None, Err(error)) => Err(error.to_string()),
        (None, Ok(_)) => Ok(text.to_owned()),
    }
}

/// From now on this process logs what the filter lets through, unless it logs somewhere already.
pub fn log_to_standard_error(filter: &str) {
    // What a link does is told by the bridge; Zenoh's own words are for `CONICFLOW_LOG=zenoh=debug`.
    let filter = EnvFilter::new(format!("zenoh=error,{filter}"));
    let is_terminal = stderr().is_terminal();
    let writer = move || Lines { place: stderr(), begin: if is_terminal { CLEAR_LINE } else { "" } };
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(writer).without_time();
    // A log that nobody reads any more is no fault of the run.
    let builder = builder.with_target(false).with_ansi(is_terminal).log_internal_errors(false);
    builder.fmt_fields(debug_fn(write_field).delimited(" ")).finish().try_init().ok();
}

/// Writes what is logged, each time at the beginning of a line.
struct Lines {
    place: Stderr,
    begin: &'static str,
}

impl Write for Lines {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        // At once: other processes write to the same terminal.
        self.place.write_all(&[self.begin.as_bytes(), text].concat())?;
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.place.flush()
    }
}

/// Writes what is logged as a terminal can show it.
fn write_field(log: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> fmt::Result {
    let text = plain(&format!("{value:?}"));
    if field.name() == "message" { log.write_str(&text) } else { write!(log, "{field}={text}") }
}

/// The text of an error as a terminal can show it.
pub fn error_text(error: impl Display) -> String {
    plain(&format!("error: {error}"))
}

/// What comes as often as others like is told once in this time.
const SELDOM: Duration = Duration::from_secs(1);

/// Warns of what may happen with each message, no more often than one can read.
#[derive(Clone, Debug, Default)]
pub struct ThrottledWarning {
    told: Option<Instant>,
    untold: u64,
}

impl ThrottledWarning {
    /// Warns of it now, or counts it for the next time.
    pub fn warn(&mut self, what: impl Display) {
        if self.told.is_some_and(|told| told.elapsed() < SELDOM) {
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
