//! Checks of the certificates in a machine's Zenoh configuration: whether they match their keys, and whether other machines
//! accept them now. (Zenoh reports neither: the link just fails.)

use conicflow_dataflow::Hinted;
use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::ServerCertVerifier as _;
use rustls::crypto::ring::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::CertifiedKey;
use rustls::{CertificateError, Error, InconsistentKeys, RootCertStore};
use serde_json::Value as Json;
use std::path::Path;
use std::sync::Arc;

const NEW_ONE: &str =
    "have it made anew, as examples/tls/certificates.sh does, and copy it to its machine with its key";
const CLOCK: &str = "is the clock of this machine right? if it is, have the certificate made anew, as \
                     examples/tls/certificates.sh does";

/// Returns the faults of the certificates in the table `transport.link.tls`: one that does not match its key, or one that
/// machines with the named authority refuse. Files that do not exist are skipped.
pub(crate) fn warnings(tls: &Json, now: UnixTime) -> Vec<Hinted> {
    let mut warnings: Vec<Hinted> = Vec::new();
    for role in ["listen", "connect"] {
        let fault = check_role(tls, role, now).err();
        warnings.extend(fault.filter(|fault| !warnings.contains(fault)));
    }
    warnings
}

fn check_role(tls: &Json, role: &str, now: UnixTime) -> Result<(), Hinted> {
    let Some(certificate) = file(tls, &format!("{role}_certificate")) else { return Ok(()) };
    file(tls, &format!("{role}_private_key")).map_or(Ok(()), |key| check_pair(certificate, key))?;
    let authority = file(tls, "root_ca_certificate");
    authority.map_or(Ok(()), |authority| examine(certificate, authority, role == "listen", now))
}

fn file<'a>(tls: &'a Json, name: &str) -> Option<&'a Path> {
    tls[name].as_str().map(Path::new).filter(|path| path.is_file())
}

fn check_pair(certificate: &Path, key: &Path) -> Result<(), Hinted> {
    let chain = read(certificate)?;
    let shown = key.display();
    let secret = PrivateKeyDer::from_pem_file(key)
        .map_err(|error| Hinted::new(format!("`{shown}` cannot be read as a private key: {error:?}"), NEW_ONE))?;
    match CertifiedKey::from_der(chain, secret, &default_provider()) {
        Err(Error::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
            let what = format!("`{shown}` is not the key of the certificate in `{}`", certificate.display());
            Err(Hinted::new(what, "were files of different machines, or of different days, mixed?"))
        }
        Err(error) => Err(Hinted::new(format!("`{shown}` cannot be used as a private key: {error}"), NEW_ONE)),
        Ok(_) => Ok(()),
    }
}

/// Reads the certificates in a file, the machine's own first.
fn read(path: &Path) -> Result<Vec<CertificateDer<'static>>, Hinted> {
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Err(error) => Err(Hinted::new(format!("cannot read `{}`: {error:?}", path.display()), NEW_ONE)),
        Ok(chain) if chain.is_empty() => {
            Err(Hinted::new(format!("no certificate is in `{}`", path.display()), NEW_ONE))
        }
        Ok(chain) => Ok(chain),
    }
}

fn examine(certificate: &Path, authority: &Path, listens: bool, now: UnixTime) -> Result<(), Hinted> {
    let (chain, mut roots) = (read(certificate)?, RootCertStore::empty());
    roots.add_parsable_certificates(read(authority)?);
    let Some((own, between)) = chain.split_first() else { return Ok(()) };
    let result = verify(own, between, Arc::new(roots), listens, now);
    let (shown, authority) = (certificate.display(), authority.display());
    match result {
        // The name by which others connect is not known here.
        None | Some(Error::InvalidCertificate(CertificateError::NotValidForNameContext { .. })) => Ok(()),
        Some(Error::InvalidCertificate(CertificateError::ExpiredContext { time, not_after })) => {
            let ago = in_words(time.as_secs().saturating_sub(not_after.as_secs()));
            Err(Hinted::new(format!("the certificate in `{shown}` has expired {ago} ago"), CLOCK))
        }
        Some(Error::InvalidCertificate(CertificateError::NotValidYetContext { time, not_before })) => {
            let ahead = in_words(not_before.as_secs().saturating_sub(time.as_secs()));
            Err(Hinted::new(format!("the certificate in `{shown}` is not valid yet, but in {ahead}"), CLOCK))
        }
        Some(Error::InvalidCertificate(CertificateError::UnknownIssuer | CertificateError::BadSignature)) => {
            let what = format!("the certificate in `{shown}` is not of the authority in `{authority}`");
            Err(Hinted::new(what, "who knows that authority alone refuses it; were files of two authorities mixed?"))
        }
        Some(error) => Err(Hinted::new(format!("the certificate in `{shown}` cannot be used: {error}"), NEW_ONE)),
    }
}

/// Returns why a machine with these authorities refuses a certificate, if it does.
fn verify(
    own: &CertificateDer<'_>,
    between: &[CertificateDer<'_>],
    roots: Arc<RootCertStore>,
    listens: bool,
    now: UnixTime,
) -> Option<Error> {
    let (provider, other) =
        (Arc::new(default_provider()), |error: &dyn std::error::Error| Error::General(error.to_string()));
    if listens {
        let verifier = WebPkiServerVerifier::builder_with_provider(roots, provider).build();
        let name = ServerName::try_from("localhost").map_err(|error| other(&error));
        let verifier = verifier.map_err(|error| other(&error));
        name.and_then(|name| verifier?.verify_server_cert(own, between, &name, &[], now)).err()
    } else {
        let verifier = WebPkiClientVerifier::builder_with_provider(roots, provider).build();
        verifier
            .map_err(|error| other(&error))
            .and_then(|verifier| verifier.verify_client_cert(own, between, now))
            .err()
    }
}

fn in_words(seconds: u64) -> String {
    match seconds {
        0..7200 => format!("{} min", seconds.div_ceil(60)),
        7200..172_800 => format!("{} h", seconds / 3600),
        _ => format!("{} days", seconds / 86_400),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;
    use std::process::Command;
    use std::time::Duration;

    const DAY: u64 = 86_400;

    /// A folder with an authority and the certificate of `robot`; `None`, with a message, if it cannot be made.
    fn made() -> Option<tempfile::TempDir> {
        let folder = tempfile::tempdir().unwrap();
        let mut script = Command::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/tls/certificates.sh"));
        let made = script.arg(folder.path()).args(["robot=localhost", "base=localhost"]).status();
        if made.is_ok_and(|status| status.success()) {
            return Some(folder);
        }
        eprintln!("SKIPPED: there is no `openssl`; nothing was shown");
        None
    }

    /// A table with the authority, certificate and key of these folders.
    fn table([authority, certificate, key]: [&Path; 3]) -> Json {
        let (certificate, key) = (certificate.join("robot.pem"), key.join("robot.key"));
        json!({
            "root_ca_certificate": authority.join("ca.pem"),
            "listen_certificate": certificate, "listen_private_key": key,
            "connect_certificate": certificate, "connect_private_key": key,
        })
    }

    fn fault_texts(warnings: &[Hinted]) -> Vec<&str> {
        warnings.iter().map(|warning| warning.what.rsplit("/robot.pem` ").next().unwrap()).collect()
    }

    #[test]
    fn a_certificate_with_its_key_can_be_used_and_with_another_it_cannot() {
        let (Some(one), Some(other)) = (made(), made()) else { return };
        let (one, other) = (one.path(), other.path());
        let faults = |table: &Json| warnings(table, UnixTime::now());
        let fault = |folders| match &faults(&table(folders))[..] {
            [fault] => fault.what.clone(),
            faults => panic!("it is told once: {faults:?}"),
        };
        assert_eq!(faults(&table([one, one, one])), []);
        let mixed = fault([one, one, other]);
        assert!(mixed.contains("/robot.key` is not the key of the certificate in `"), "{mixed}");
        std::fs::write(other.join("robot.key"), "no key").unwrap();
        let none = fault([one, one, other]);
        assert!(none.contains("/robot.key` cannot be read as a private key: "), "{none}");
        std::fs::write(other.join("robot.pem"), "no certificate").unwrap();
        let none = fault([one, other, one]);
        assert!(none.starts_with("no certificate is in `"), "{none}");
        std::fs::remove_file(other.join("robot.pem")).unwrap();
        assert_eq!(faults(&table([one, other, one])), [], "files of other machines need not be here");
    }

    #[test]
    fn an_expired_early_or_foreign_certificate_is_reported_once() {
        let (Some(one), Some(other)) = (made(), made()) else { return };
        let (one, other) = (one.path(), other.path());
        let in_days = |days: i64| {
            let seconds = UnixTime::now().as_secs().saturating_add_signed(days * DAY as i64);
            UnixTime::since_unix_epoch(Duration::from_secs(seconds))
        };
        let own = table([one, one, one]);
        for (days, expected) in [
            (0, &[][..]),
            (800, &[]),
            (835, &["has expired 10 days ago"]),
            (-10, &["is not valid yet, but in 10 days"]),
        ] {
            let warnings = warnings(&own, in_days(days));
            let reported = fault_texts(&warnings);
            // A second may have passed since the certificate was made.
            let is_as_expected = reported == expected || reported == ["is not valid yet, but in 9 days"] && days == -10;
            assert!(is_as_expected || reported == ["has expired 9 days ago"] && days == 835, "{days}: {reported:?}");
        }
        let mixed = warnings(&table([other, one, one]), UnixTime::now());
        assert!(mixed.len() == 1 && fault_texts(&mixed)[0].starts_with("is not of the authority in `"), "{mixed:?}");
        assert!(warnings(&Json::Null, UnixTime::now()).is_empty());
    }

    #[test]
    fn a_certificate_for_servers_alone_is_accepted_for_listening_and_refused_for_connecting() {
        let Some(folder) = made() else { return };
        let script = "printf 'subjectAltName=DNS:localhost\nextendedKeyUsage=serverAuth\n' > usage\n\
                      openssl req -new -key robot.key -subj /CN=robot | openssl x509 -req -CA ca.pem -CAkey ca.key \
                      -CAcreateserial -days 825 -extfile usage -out robot.pem";
        let mut shell = Command::new("sh");
        assert!(shell.args(["-ec", script]).current_dir(&folder).output().unwrap().status.success());
        let faults = |other: &str| {
            let mut table = table([folder.path(); 3]);
            table.as_object_mut().unwrap().retain(|name, _| !name.starts_with(other));
            warnings(&table, UnixTime::now())
        };
        assert_eq!(faults("connect"), []);
        let fault = &faults("listen")[..];
        assert!(fault.len() == 1 && fault_texts(fault)[0].starts_with("cannot be used: "), "{fault:?}");
    }

    #[test]
    fn durations_are_reported_in_suitable_units() {
        let words = [0, 61, 7199, 7200, 172_799, 172_800].map(in_words);
        assert_eq!(words, ["0 min", "2 min", "120 min", "2 h", "47 h", "2 days"]);
    }
}
