//! The notes of a bridge for the process that replaces it if it is killed: a file in the run's folder.

use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{fs, io};

/// An edge that is finished: the stages that read it on the receiving machine have heard its end, and nothing more is wanted.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub(crate) struct FinishedEdge {
    /// The machine that sends it.
    pub from: String,
    /// The machine that receives it.
    pub to: String,
    pub topic: String,
    /// The run of the machine that sends it.
    pub run: u64,
}

/// The acknowledged end of a writer's stream. The sending machine may have left since.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
struct AcknowledgedEnd {
    from: String,
    topic: String,
    writer: String,
    /// The number of messages that the writer sent.
    count: u64,
}

/// The content of the journal.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
struct Entries {
    run: u64,
    session: u64,
    heard: BTreeSet<String>,
    /// Finished edges, each with the run of the receiving machine that wants nothing more; its next run may.
    finished: BTreeSet<(FinishedEdge, u64)>,
    ends: BTreeSet<AcknowledgedEnd>,
}

/// The journal of a bridge.
#[derive(Clone, Debug, Default)]
pub(crate) struct Journal {
    path: Option<PathBuf>,
    entries: Entries,
}

impl Journal {
    /// Opens the journal of this run, with the notes of earlier processes in that folder. Without a folder it is kept in memory
    /// only, for a process that nobody replaces. A new session begins; its number is greater than all before, even if the clock
    /// was set back.
    pub(crate) fn open(folder: Option<&Path>, run: u64, now: u64) -> Self {
        let path = folder.map(|folder| folder.join("bridge.journal"));
        let left = path.as_ref().and_then(|path| serde_json::from_slice::<Entries>(&fs::read(path).ok()?).ok());
        let mut entries = left.filter(|entries| entries.run == run).unwrap_or(Entries { run, ..Entries::default() });
        entries.session = now.max(entries.session.saturating_add(1));
        let mut journal = Self { path, entries };
        journal.write();
        journal
    }

    /// The run that the journal belongs to.
    pub(crate) fn run(&self) -> u64 {
        self.entries.run
    }

    /// The number of this start of the bridge.
    pub(crate) fn session(&self) -> u64 {
        self.entries.session
    }

    /// Whether a machine was heard in this run.
    pub(crate) fn has_heard(&self, machine: &str) -> bool {
        self.entries.heard.contains(machine)
    }

    pub(crate) fn note_heard(&mut self, machine: &str) {
        if self.entries.heard.insert(machine.to_owned()) {
            self.write();
        }
    }

    /// The finished edges, each with the run of the receiving machine that wants nothing more of it.
    pub(crate) fn finished(&self) -> impl Iterator<Item = (&FinishedEdge, u64)> {
        self.entries.finished.iter().map(|(edge, by)| (edge, *by))
    }

    pub(crate) fn note_finished(&mut self, edge: FinishedEdge, by: u64) {
        if self.entries.finished.insert((edge, by)) {
            self.write();
        }
    }

    pub(crate) fn forget_finished(&mut self, edge: &FinishedEdge, by: u64) {
        if self.entries.finished.remove(&(edge.clone(), by)) {
            self.write();
        }
    }

    /// The writers of an edge to here that have ended, with the number of messages of each.
    pub(crate) fn ends(&self, from: &str, topic: &str) -> BTreeMap<String, u64> {
        let of_edge = self.entries.ends.iter().filter(|end| end.from == from && end.topic == topic);
        of_edge.map(|end| (end.writer.clone(), end.count)).collect()
    }

    pub(crate) fn note_end(&mut self, from: &str, topic: &str, writer: &str, count: u64) {
        let [from, topic, writer] = [from, topic, writer].map(str::to_owned);
        if self.entries.ends.insert(AcknowledgedEnd { from, topic, writer, count }) {
            self.write();
        }
    }

    /// Writes the file. If that fails, this process goes on, but the next one will lack the notes.
    fn write(&mut self) {
        let Some(path) = &self.path else { return };
        let draft = path.with_extension("journal.new");
        let text = serde_json::to_vec(&self.entries).map_err(io::Error::from);
        let written = text.and_then(|text| fs::write(&draft, text)).and_then(|()| fs::rename(&draft, path));
        if let Err(error) = written {
            tracing::warn!("should the bridge be killed, the next will not know what is finished: {error}");
            self.path = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edge(topic: &str) -> FinishedEdge {
        FinishedEdge { from: "robot".to_owned(), to: "base".to_owned(), topic: topic.to_owned(), run: 7 }
    }

    #[test]
    fn the_next_process_of_a_run_reads_the_journal_of_the_one_before_and_has_a_later_session() {
        let folder = tempfile::tempdir().unwrap();
        let mut first = Journal::open(Some(folder.path()), 7, 1000);
        first.note_heard("base");
        first.note_finished(edge("objects"), 3);
        for (from, topic, writer, count) in [
            ("robot", "objects", "left", 8),
            ("robot", "objects", "right", 9),
            ("robot", "depth", "left", 7),
            ("desk", "objects", "left", 6),
        ] {
            first.note_end(from, topic, writer, count);
        }
        let next = Journal::open(Some(folder.path()), 7, 10);
        assert_eq!((first.session(), next.session()), (1000, 1001), "the clock was set back");
        assert!(next.has_heard("base") && !next.has_heard("robot"));
        assert!(next.finished().eq([(&edge("objects"), 3)]));
        assert_eq!(
            next.ends("robot", "objects"),
            [("left", 8), ("right", 9)].map(|(writer, count)| (writer.to_owned(), count)).into()
        );
        assert_eq!(next.ends("base", "objects"), BTreeMap::new());
        let other_run = Journal::open(Some(folder.path()), 8, 2000);
        assert!(!other_run.has_heard("base") && other_run.finished().next().is_none());
        assert!(other_run.ends("robot", "objects").is_empty());
    }

    #[test]
    fn a_journal_that_cannot_be_read_or_written_stops_no_bridge() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("bridge.journal"), "{ not whole").unwrap();
        assert_eq!(Journal::open(Some(folder.path()), 7, 5).session(), 5);
        for folder in [None, Some(Path::new("/nowhere"))] {
            let mut journal = Journal::open(folder, 7, 5);
            journal.note_finished(edge("objects"), 3);
            assert_eq!(journal.finished().count(), 1);
        }
    }
}
