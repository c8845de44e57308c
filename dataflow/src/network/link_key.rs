//! Secret key that the machines of a pipeline share, to authenticate their messages: a file with 32 random bytes as hexadecimal
//! digits, which only its owner can read.

use conicflow_messages::Hinted;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Length of a key in bytes.
const LENGTH: usize = 32;
/// Number of bytes to read from a file: the digits of a key, and some more, to detect a longer file.
const LONGEST_FILE: u64 = 4 * LENGTH as u64;
/// Permission bits of all users but the owner.
const OTHERS: u32 = 0o077;

/// Key of the machines of a pipeline.
#[derive(Clone, PartialEq, Eq)]
pub struct LinkKey([u8; LENGTH]);

impl std::fmt::Debug for LinkKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("LinkKey(..)")
    }
}

impl LinkKey {
    /// Creates the file of a new key, which only this user can read.
    ///
    /// # Errors
    /// The file exists, and is left as it is; or it cannot be created.
    pub fn make(path: &Path) -> Result<(), Hinted> {
        let secret = random().map_err(|error| {
            Hinted::new(format!("`/dev/urandom` cannot be read for a key: {error}"), "is /dev there, as it should be?")
        })?;
        let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path);
        let written = made.and_then(|mut file| file.write_all(&digits(&secret)));
        written.map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => Hinted::new(
                format!("there is a file `{}`, which is left as it is", path.display()),
                "copy that one to the other machines, or name another file",
            ),
            _ => Hinted::of_writing(format!("cannot write the key `{}`: {error}", path.display()), &error),
        })
    }

    /// Reads the file of a key.
    ///
    /// # Errors
    /// Other users can read it, too, or it has other content.
    pub fn read(path: &Path) -> Result<Self, Hinted> {
        let shown = path.display();
        let (mode, text) = read_file(path).map_err(|error| {
            Hinted::new(format!("cannot read the key `{shown}`: {error}"), "`conicflow key` makes such a file")
        })?;
        if mode & OTHERS != 0 {
            let what = format!("the key `{shown}` is open to others, its mode is {:03o}", mode & 0o777);
            return Err(Hinted::new(what, format!("`chmod 600 {shown}`; if others may have read it, make another")));
        }
        let secret = secret_of(text.trim());
        secret.map(Self).ok_or_else(|| {
            let what = format!("`{shown}` is no key: expected {} hexadecimal digits", 2 * LENGTH);
            Hinted::new(what, "`conicflow key` makes such a file; it has to be the same on all machines")
        })
    }

    /// The key of this user on this machine, created at the first call. It is for pipelines whose machines are all this host, and
    /// listen where its other users can connect, too.
    ///
    /// # Errors
    /// There is no place for it, or the file is not a key.
    pub fn of_user() -> Result<Self, Hinted> {
        let path = user_path()?;
        let hint = "name a key in the tables of all machines: `conicflow key` makes one";
        let fault = |error| Hinted::new(format!("cannot make the key `{}`: {error}", path.display()), hint);
        make_once(&path).map_err(fault)?;
        Self::read(&path)
    }

    /// Its bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }
}

fn read_file(path: &Path) -> io::Result<(u32, String)> {
    let (file, mut text) = (File::open(path)?, String::new());
    let mode = file.metadata()?.mode();
    file.take(LONGEST_FILE).read_to_string(&mut text)?;
    Ok((mode, text))
}

fn random() -> io::Result<[u8; LENGTH]> {
    let mut secret = [0; LENGTH];
    File::open("/dev/urandom")?.read_exact(&mut secret)?;
    Ok(secret)
}

fn digits(secret: &[u8; LENGTH]) -> Vec<u8> {
    let text: String = secret.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("{text}\n").into_bytes()
}

fn secret_of(text: &str) -> Option<[u8; LENGTH]> {
    if text.len() != 2 * LENGTH || !text.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return None;
    }
    let mut secret = [0; LENGTH];
    for (byte, at) in secret.iter_mut().zip((0..).step_by(2)) {
        *byte = u8::from_str_radix(&text[at..at + 2], 16).ok()?;
    }
    Some(secret)
}

/// Path of this user's key.
fn user_path() -> Result<PathBuf, Hinted> {
    let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let state = folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")));
    state.map(|state| state.join("conicflow/loopback.key")).ok_or_else(|| {
        let what = "machines that meet on this host need a key, and without HOME there is no place for this user's own";
        Hinted::new(what, "name a key in the tables of all machines: `conicflow key` makes one")
    })
}

/// Creates a file with a new key, unless it exists. It appears atomically for concurrent readers.
fn make_once(path: &Path) -> io::Result<()> {
    if path.exists() {
        return Ok(());
    }
    if let Some(folder) = path.parent() {
        DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    }
    let own = path.with_extension(format!("key.{}", std::process::id()));
    // A file that a killed process with the same id has left is overwritten.
    let mut file = OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(&own)?;
    let linked = file.write_all(&digits(&random()?)).and_then(|()| fs::hard_link(&own, path));
    fs::remove_file(&own)?;
    linked.or_else(|error| if error.kind() == ErrorKind::AlreadyExists { Ok(()) } else { Err(error) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_key_is_made_once_and_read_as_it_was_made() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("robot.key");
        LinkKey::make(&path).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        let key = LinkKey::read(&path).unwrap();
        assert_eq!(digits(&key.0), text.as_bytes());
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        assert!(LinkKey::make(&path).unwrap_err().what.contains("which is left as it is"));
        assert_eq!(fs::read_to_string(&path).unwrap(), text);
        let other = folder.path().join("other.key");
        LinkKey::make(&other).unwrap();
        assert_ne!(LinkKey::read(&other).unwrap(), key);
        assert!(!format!("{key:?}").contains(&text[..8]), "a key is not shown");
    }

    #[test]
    fn a_key_that_others_can_read_or_that_is_none_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("robot.key");
        LinkKey::make(&path).unwrap();
        for mode in [0o640, 0o604, 0o660, 0o601] {
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            let error = LinkKey::read(&path).unwrap_err().to_string();
            assert!(error.contains(&format!("its mode is {mode:03o}")) && error.contains("chmod 600"), "{error}");
        }
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        let good = fs::read_to_string(&path).unwrap();
        for bad in ["", &good[2..], &format!("{}g{}", &good[..1], &good[2..]), &good.repeat(2), &"é".repeat(LENGTH)] {
            fs::write(&path, bad).unwrap();
            assert!(LinkKey::read(&path).unwrap_err().what.contains("is no key"), "{bad}");
        }
    }

    #[test]
    fn the_key_of_a_user_is_made_once_in_a_folder_of_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/folder/loopback.key");
        make_once(&path).unwrap();
        let first = LinkKey::read(&path).unwrap();
        make_once(&path).unwrap();
        assert_eq!(LinkKey::read(&path).unwrap(), first);
        let folder = path.parent().unwrap();
        assert_eq!(fs::read_dir(folder).unwrap().count(), 1, "nothing else is left there");
        assert_eq!(fs::metadata(folder).unwrap().mode() & 0o777, 0o700);
    }
}
