//! Files that a stage or a command reads or writes; conflicts are detected, so that no input is ever overwritten.
//!
//! Two paths name the same file if the system says so, by device and inode. A file that does not exist yet is identified by its
//! nearest existing folder and the rest of its path. Anything but a file or folder, such as `/dev/null` or a pipe, stores
//! nothing, and may be written by all.

use conicflow_messages::Hinted;
use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Component, Path, PathBuf};

/// Maximum number of symbolic links followed in a row, as in Linux.
const MAX_LINKS: usize = 40;

/// Files that are read or written, and the parameter that names them.
#[derive(Clone, Debug)]
pub struct FileUse {
    /// Name of the parameter.
    pub key: &'static str,
    path: PathBuf,
    names: Names,
    /// Identity of the file, or of the folder of several.
    identity: Option<Identity>,
}

/// Names of the files.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Names {
    /// A single file with a known path.
    Known,
    /// Files of a folder with a number between these two texts.
    Numbered { prefix: String, ending: String },
    /// Files of a folder with this ending.
    Ending(String),
}

/// Identity of a file or a folder.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Identity {
    device: u64,
    inode: u64,
    /// Path from there to a file that does not exist yet.
    rest: PathBuf,
}

impl FileUse {
    /// One file, named by the parameter `key`; it need not exist. A folder in its place is reported elsewhere.
    pub fn one(key: &'static str, path: PathBuf) -> Self {
        let identity = Identity::of(&path).filter(|_| !path.is_dir());
        Self { key, identity, path, names: Names::Known }
    }

    /// The files of those parameters that are given, with paths relative to `base`.
    pub fn given<const N: usize>(base: &Path, parameters: [(&'static str, &Option<PathBuf>); N]) -> Vec<Self> {
        let file = |(key, path): (_, &Option<PathBuf>)| path.as_ref().map(|path| Self::one(key, base.join(path)));
        parameters.into_iter().filter_map(file).collect()
    }

    /// Numbered files of a folder, such as `frame_000012.png` with `frame_` and `.png`.
    pub fn numbered(key: &'static str, folder: PathBuf, prefix: impl Into<String>, ending: impl Into<String>) -> Self {
        let names = Names::Numbered { prefix: prefix.into(), ending: ending.into() };
        Self { key, identity: Identity::of(&folder), path: folder, names }
    }

    /// Files of a folder of which only the ending is known, such as `.png`.
    pub fn ending(key: &'static str, folder: PathBuf, ending: impl Into<String>) -> Self {
        Self { key, identity: Identity::of(&folder), path: folder, names: Names::Ending(ending.into()) }
    }

    /// Error if these files may overwrite the files `read`; `reader` and `writer` describe the parameters.
    pub fn conflict_with_read(&self, writer: &str, read: &Self, reader: &str) -> Option<Hinted> {
        if !self.meets(read) {
            return None;
        }
        let (path, other) = (self.path.display(), read.path.display());
        Some(match (&self.names, &read.names) {
            (Names::Known, Names::Known) => Hinted::new(
                format!("{writer} writes the file `{path}`, which {reader} reads"),
                "name another file: what is read is never written over",
            ),
            (Names::Known, _) => Hinted::new(
                format!("{writer} writes the file `{path}` into the folder that {reader} reads"),
                "name a file in another folder: what is read is never written over",
            ),
            _ => Hinted::new(
                format!("{writer} writes files into the folder `{path}`, from which {reader} reads `{other}`"),
                "name a folder of their own: what is read is never written over",
            ),
        })
    }

    /// Error if these files may be the same as those of another writer. Files known only by their ending are assumed to differ.
    pub fn conflict_with_written(&self, writer: &str, other: &Self, other_writer: &str) -> Option<Hinted> {
        let are_known = [self, other].iter().all(|files| !matches!(files.names, Names::Ending(_)));
        (are_known && self.meets(other)).then(|| {
            let what = format!("{writer} writes what {other_writer} writes, too: `{}`", self.path.display());
            Hinted::new(what, "give each a file or a folder of its own: one would spoil what the other has written")
        })
    }

    /// Error if this file, which the stage would start to write during a run, exists already and is not one of `before`, the
    /// stage's files so far: it would be continued as if it were.
    pub(crate) fn conflict_with_existing(&self, writer: &str, before: &[Self]) -> Option<Hinted> {
        let is_new = self.names == Names::Known && self.path.is_file() && !before.iter().any(|own| self.meets(own));
        let what = || format!("{writer} would go on with `{}`, which is there already", self.path.display());
        is_new.then(|| Hinted::new(what(), "name another file, or move that one away"))
    }

    /// Whether the two sets may have a file in common.
    fn meets(&self, other: &Self) -> bool {
        match (&self.names, &other.names) {
            (Names::Known, Names::Known) => self.identity.is_some() && self.identity == other.identity,
            (Names::Known, _) => other.takes_in(&self.path),
            (_, Names::Known) => self.takes_in(&other.path),
            (own, others) => self.identity.is_some() && self.identity == other.identity && own.meet(others),
        }
    }

    /// Whether a file is one of those of a folder.
    fn takes_in(&self, file: &Path) -> bool {
        let Some(name) = file.file_name() else { return false };
        let is_called_so = self.names.take_in(&name.to_string_lossy());
        is_called_so && self.identity.is_some() && Identity::of(&folder_of(file)) == self.identity
    }
}

fn folder_of(file: &Path) -> PathBuf {
    file.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new(".")).to_owned()
}

impl Names {
    fn take_in(&self, name: &str) -> bool {
        match self {
            Self::Known => false,
            Self::Numbered { prefix, ending } => {
                let number = name.strip_prefix(prefix.as_str()).and_then(|rest| rest.strip_suffix(ending.as_str()));
                number.is_some_and(|number| !number.is_empty() && number.bytes().all(|digit| digit.is_ascii_digit()))
            }
            Self::Ending(ending) => ends_in(name, ending),
        }
    }

    fn meet(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Numbered { ending, .. }, Self::Ending(other))
            | (Self::Ending(other), Self::Numbered { ending, .. }) => ends_in(ending, other),
            _ => self == other,
        }
    }
}

/// Whether a name has this ending, in lower or upper case.
fn ends_in(name: &str, ending: &str) -> bool {
    name.to_lowercase().ends_with(&ending.to_lowercase())
}

impl Identity {
    /// Identity of a path, if it is or may become a file or a folder.
    fn of(path: &Path) -> Option<Self> {
        let mut path = std::path::absolute(path).ok()?;
        // A link to a missing file: the file is created at the link's target.
        for _ in 0..MAX_LINKS {
            let Some(target) = path.read_link().ok().filter(|_| !path.exists()) else { break };
            path = folder_of(&path).join(target);
        }
        match path.metadata() {
            Ok(about) => (about.is_file() || about.is_dir()).then(|| Self::at(&about, PathBuf::new())),
            Err(_) => Self::of_missing(&path),
        }
    }

    fn at(about: &Metadata, rest: PathBuf) -> Self {
        Self { device: about.dev(), inode: about.ino(), rest }
    }

    fn of_missing(path: &Path) -> Option<Self> {
        let (above, about) = path.ancestors().find_map(|above| Some((above, above.metadata().ok()?)))?;
        let rest = path.strip_prefix(above).ok()?;
        if !rest.components().any(|part| part == Component::ParentDir) {
            return Some(Self::at(&about, rest.to_owned()));
        }
        // The missing folders will be created, and are no links, so `..` cancels the part before it.
        let mut resolved = PathBuf::new();
        for part in rest.components() {
            if part == Component::ParentDir { resolved.pop().then_some(())? } else { resolved.push(part) }
        }
        Self::of(&above.join(resolved))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{create_dir, hard_link, write};
    use std::os::unix::fs::symlink;
    use tempfile::{TempDir, tempdir};

    /// A folder `frames` with a file `0.png`, and links to both.
    fn frames() -> TempDir {
        let folder = tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        create_dir(at("frames")).unwrap();
        write(at("frames/0.png"), "depth").unwrap();
        symlink("frames", at("link")).unwrap();
        symlink("frames/0.png", at("link.png")).unwrap();
        symlink("frames/new.png", at("dangling.png")).unwrap();
        symlink("circle", at("circle")).unwrap();
        hard_link(at("frames/0.png"), at("other.png")).unwrap();
        folder
    }

    fn one(folder: &TempDir, path: &str) -> FileUse {
        FileUse::one("path", folder.path().join(path))
    }

    #[test]
    fn a_file_is_the_same_by_whatever_path() {
        let folder = frames();
        let frame = one(&folder, "frames/0.png");
        for same in
            ["frames/0.png", "frames/../frames/./0.png", "link/0.png", "link.png", "other.png", "new/../link/0.png"]
        {
            let told = one(&folder, same).conflict_with_read("a", &frame, "b").unwrap();
            assert!(told.what.ends_with("which b reads"), "{told}");
            assert!(one(&folder, same).conflict_with_written("a", &frame, "b").is_some(), "{same}");
        }
        for other in ["frames/1.png", "0.png", "frames", "frames/0.png/0.png", "circle"] {
            assert!(one(&folder, other).conflict_with_read("a", &frame, "b").is_none(), "{other}");
        }
    }

    #[test]
    fn a_file_that_is_not_there_yet_is_the_same_by_whatever_path() {
        let folder = frames();
        for (path, same) in [
            ("frames/new.png", "link/new.png"),
            ("frames/new.png", "dangling.png"),
            ("a/b/new.jsonl", "a/./b/../b/c/../new.jsonl"),
            ("frames/a/new.jsonl", "link/a/new.jsonl"),
        ] {
            assert!(one(&folder, path).meets(&one(&folder, same)), "{path} {same}");
        }
        for (path, other) in
            [("frames/new.png", "new.png"), ("a/new", "b/new"), ("a/b", "a"), ("../../../../../../../a", "b")]
        {
            assert!(!one(&folder, path).meets(&one(&folder, other)), "{path} {other}");
        }
    }

    #[test]
    fn what_keeps_nothing_may_be_written_by_all() {
        for place in ["/dev/null", "/dev/full"] {
            let place = FileUse::one("path", place.into());
            assert!(!place.meets(&place), "{place:?}");
        }
        let folder = one(&frames(), "frames");
        assert!(!folder.meets(&folder), "it is no file");
    }

    #[test]
    fn names_that_come_only_while_it_runs_are_told_by_what_is_known_of_them() {
        let folder = frames();
        let pictures = |name: &str| FileUse::ending("path", folder.path().join(name), ".png");
        let numbered = |prefix: &str| FileUse::numbered("path", folder.path().join("link"), prefix, ".png");
        let frame = one(&folder, "frames/0.png");
        for name in ["frames", "link", "link/."] {
            assert!(pictures(name).conflict_with_read("a", &frame, "b").is_some(), "{name}");
            assert!(one(&folder, "frames/new.PNG").conflict_with_read("a", &pictures(name), "b").is_some(), "{name}");
            assert!(
                one(&folder, "frames/all.png").conflict_with_written("a", &pictures(name), "b").is_none(),
                "{name}"
            );
            assert!(numbered("frame_").conflict_with_read("a", &pictures(name), "b").is_some(), "{name}");
        }
        assert!(!pictures(".").meets(&frame) && !pictures("frames").meets(&one(&folder, "frames/camera.json")));
        assert!(numbered("").meets(&frame) && !numbered("frame_").meets(&frame));
        assert!(numbered("frame_").conflict_with_written("a", &numbered("frame_"), "b").is_some());
        assert!(numbered("frame_").conflict_with_written("a", &numbered("sheet_"), "b").is_none());
        assert!(numbered("sheet_").meets(&one(&folder, "frames/sheet_0001.png")));
        assert!(!numbered("sheet_").meets(&one(&folder, "frames/sheet_.png")));
    }
}
