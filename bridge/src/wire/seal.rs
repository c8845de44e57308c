//! The codes that authenticate messages between the machines of a pipeline that share a key.
//!
//! The code is an HMAC-SHA256 with that key over the length of the Zenoh key as a little-endian `u64`, the Zenoh key, and all
//! bytes of the message except the code. So nobody without the key can make a message, change one, or move one to another topic.
//! A replayed message is detected by its session, which the sender has to prove to be the present one (`peer::links`), and within
//! a session by its number or, for a heartbeat, its time.

use super::{PREFIX, WireError, content};
use conicflow_dataflow::LinkKey;
use ring::digest::SHA256_OUTPUT_LEN;
use ring::hmac::{Context, HMAC_SHA256, Key, Tag};
use subtle::ConstantTimeEq;

/// Length of the session in bytes.
const SESSION: usize = size_of::<u64>();
/// Length of the session and the code in bytes. Both are written when the message goes out.
pub(super) const SEAL: usize = SESSION + SHA256_OUTPUT_LEN;
/// Where the code begins.
const CODE: usize = PREFIX + SESSION;
/// Where the code ends.
const SEALED: usize = PREFIX + SEAL;

/// Computes and checks codes.
pub(crate) struct Seal {
    key: Option<Key>,
    /// Number of this start of the bridge.
    session: u64,
}

impl Seal {
    /// Creates the seal of this start of the bridge. Without a key, messages have no codes, and all messages without a code are
    /// accepted.
    pub(crate) fn new(key: Option<&LinkKey>, session: u64) -> Self {
        Self { key: key.map(|key| Key::new(HMAC_SHA256, key.bytes())), session }
    }

    pub(crate) fn has_key(&self) -> bool {
        self.key.is_some()
    }

    /// Writes the session and, with a key, the code into a message or note before it goes out under this Zenoh key.
    pub(crate) fn sign(&self, zenoh_key: &str, bytes: &mut [u8]) {
        bytes[PREFIX..CODE].copy_from_slice(&self.session.to_le_bytes());
        if let Some(key) = &self.key {
            let code = code(key, zenoh_key, bytes);
            bytes[CODE..SEALED].copy_from_slice(code.as_ref());
        }
    }

    /// Checks the code of a message that came under this Zenoh key; returns the session that the message names.
    pub(crate) fn verify(&self, zenoh_key: &str, bytes: &[u8]) -> Result<u64, WireError> {
        content(bytes)?;
        let code_in_message = &bytes[CODE..SEALED];
        let has_code = code_in_message.iter().any(|byte| *byte != 0);
        match &self.key {
            Some(_) if !has_code => Err(WireError::NoCode),
            None if has_code => Err(WireError::UnexpectedCode),
            // In constant time, which does not reveal where the two differ.
            Some(key) if !bool::from(code(key, zenoh_key, bytes).as_ref().ct_eq(code_in_message)) => {
                Err(WireError::WrongCode)
            }
            _ => Ok(session_of(bytes)),
        }
    }
}

/// The session that a message names; 0 if the message is too short.
pub(crate) fn session_of(bytes: &[u8]) -> u64 {
    bytes.get(PREFIX..CODE).unwrap_or_default().iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte))
}

/// Computes the code of a message, ignoring the code that it holds.
fn code(key: &Key, zenoh_key: &str, bytes: &[u8]) -> Tag {
    let mut context = Context::with_key(key);
    context.update(&(zenoh_key.len() as u64).to_le_bytes());
    [zenoh_key.as_bytes(), &bytes[..CODE], &bytes[SEALED..]].iter().for_each(|part| context.update(part));
    context.sign()
}

/// A new secret.
#[cfg(test)]
#[allow(clippy::unwrap_used)] // in tests, a panic is a failure
pub(crate) fn secret() -> LinkKey {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.key");
    LinkKey::make(&path).unwrap();
    LinkKey::read(&path).unwrap()
}

#[cfg(test)]
mod tests {
    use super::super::opening_bytes;
    use super::*;

    const ZENOH_KEY: &str = "conicflow/tracking/robot/ellipses";

    fn closed(seal: &Seal) -> Vec<u8> {
        let mut bytes = [opening_bytes().as_slice(), b"place, header and body"].concat();
        seal.sign(ZENOH_KEY, &mut bytes);
        bytes
    }

    #[test]
    fn a_message_sealed_with_the_key_passes_and_names_its_session() {
        let secret = secret();
        let (ours, theirs) = (Seal::new(Some(&secret), 1), Seal::new(Some(&secret), 0x0102_0304_0506_0708));
        assert_eq!(ours.verify(ZENOH_KEY, &closed(&theirs)), Ok(0x0102_0304_0506_0708));
        let plain = Seal::new(None, 7);
        assert!(ours.has_key() && !plain.has_key());
        assert_eq!(plain.verify(ZENOH_KEY, &closed(&plain)), Ok(7));
    }

    #[test]
    fn a_message_with_any_byte_changed_added_or_missing_does_not_pass() {
        let seal = Seal::new(Some(&secret()), 1);
        let good = closed(&seal);
        for at in 0..good.len() {
            for change in [1, 0x80, 0xff] {
                let mut bytes = good.clone();
                bytes[at] ^= change;
                let error = seal.verify(ZENOH_KEY, &bytes).unwrap_err();
                let expected = match at {
                    0..4 => matches!(error, WireError::Foreign),
                    4..6 => matches!(error, WireError::Version { .. }),
                    _ => error == WireError::WrongCode,
                };
                assert!(expected, "byte {at} ^ {change}: {error}");
            }
            assert!(seal.verify(ZENOH_KEY, &good[..at]).is_err(), "cut at {at}");
        }
        assert_eq!(seal.verify(ZENOH_KEY, &[good.as_slice(), &[0]].concat()), Err(WireError::WrongCode));
    }

    #[test]
    fn a_message_of_another_topic_machine_or_pipeline_does_not_pass() {
        let seal = Seal::new(Some(&secret()), 1);
        let good = closed(&seal);
        for other in
            ["conicflow/tracking/robot/objects", "conicflow/other/robot/ellipses", "conicflow/tracking/robot", ""]
        {
            assert_eq!(seal.verify(other, &good), Err(WireError::WrongCode), "{other}");
        }
    }

    #[test]
    fn a_message_sealed_with_another_key_or_none_does_not_pass() {
        let [ours, theirs] = [(); 2].map(|()| Seal::new(Some(&secret()), 1));
        let plain = Seal::new(None, 1);
        assert_eq!(ours.verify(ZENOH_KEY, &closed(&theirs)), Err(WireError::WrongCode));
        assert_eq!(ours.verify(ZENOH_KEY, &closed(&plain)), Err(WireError::NoCode));
        assert_eq!(plain.verify(ZENOH_KEY, &closed(&ours)), Err(WireError::UnexpectedCode));
        for seal in [&ours, &plain] {
            for cut in [&b""[..], b"CFLO", &closed(seal)[..SEALED - 1]] {
                assert!(seal.verify(ZENOH_KEY, cut).is_err());
            }
        }
    }
}
