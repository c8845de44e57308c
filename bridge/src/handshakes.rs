//! Reports why a TLS link fails. Zenoh only logs the failure and retries for ever. This layer reads Zenoh's log and reports each
//! failed handshake once, saying which side has refused which, and why.

use crate::logged_once::LoggedOnce;
use conicflow_dataflow::lock;
use std::fmt::{Debug, Write as _};
use std::sync::Mutex;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

/// Reasons to report now, and all that were ever reported.
static REASONS: Mutex<(Vec<String>, LoggedOnce)> = Mutex::new((Vec::new(), LoggedOnce::new()));

/// A log layer that reads Zenoh's log, in addition to what the user sees of it.
pub fn handshake_layer<S: Subscriber + for<'a> LookupSpan<'a>>() -> impl Layer<S> {
    let targets = Targets::new().with_target("zenoh::net::runtime::orchestrator", Level::DEBUG);
    let links = ["zenoh_link_tls", "zenoh_link_quic", "zenoh_link_commons"].map(|target| (target, Level::WARN));
    LogListener.with_filter(targets.with_targets(links))
}

struct LogListener;

impl<S: Subscriber> Layer<S> for LogListener {
    /// Must not log: it runs inside Zenoh's logging.
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut message = Message(String::new());
        event.record(&mut message);
        let Some(reason) = refusal(&message.0) else { return };
        let (pending, logged) = &mut *lock(&REASONS);
        if logged.admits(&reason) {
            pending.push(reason);
        }
    }
}

/// The text of an event.
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            write!(self.0, "{value:?}").ok();
        }
    }
}

/// Logs the reasons that were found since the last call.
pub(crate) fn report() {
    let (pending, _) = &mut *lock(&REASONS);
    pending.drain(..).for_each(|reason| tracing::error!("{reason}"));
}

/// The reason of a failed handshake, if this line of Zenoh's log reports one.
fn refusal(line: &str) -> Option<String> {
    let endpoint = line.split_once("Unable to connect to ").and_then(|(_, rest)| {
        let rest = rest.strip_prefix("configured peer ").unwrap_or(rest);
        rest.split('!').next()
    });
    let peer = endpoint.map_or("somebody who connects".to_owned(), |endpoint| format!("the machine at `{endpoint}`"));
    let after = |phrase: &str| line.split_once(phrase).map(|(_, rest)| rest);
    if let Some(fault) = after("invalid peer certificate: ") {
        let (what_of, hint) = fault_of_theirs(fault);
        return Some(format!("refused {peer}: its certificate {what_of}\n  hint: {hint}"));
    }
    if after("peer sent no certificates").is_some() {
        return Some(format!(
            "refused {peer}: it shows no certificate\n  hint: with enable_mtls: true here, each machine needs enable_mtls: \
             true, connect_certificate and connect_private_key"
        ));
    }
    let alert = after("received fatal alert: ")?.split(|letter: char| !letter.is_ascii_alphanumeric()).next()?;
    let (what_of, hint) = fault_of_ours(alert);
    Some(format!("{peer} refuses this machine: {what_of}\n  hint: {hint}"))
}

const ONE_AUTHORITY: &str = "have certificates of one authority on all machines, and its ca.pem, as \
                             examples/tls/certificates.sh makes them";

/// Describes the fault of a certificate that was shown, and what to do.
fn fault_of_theirs(fault: &str) -> (String, &'static str) {
    if fault.starts_with("certificate expired") || fault.starts_with("Expired") {
        return ("has expired".to_owned(), "give that machine a new one; or is the clock of this one wrong?");
    }
    if fault.starts_with("certificate not valid yet") || fault.starts_with("NotValidYet") {
        return ("is not valid yet".to_owned(), "is the clock of this machine right?");
    }
    if fault.starts_with("UnknownIssuer") || fault.starts_with("BadSignature") {
        return ("is of an authority that this machine does not know".to_owned(), ONE_AUTHORITY);
    }
    let fault = fault.split(" at /").next().unwrap_or(fault);
    match fault.strip_prefix("certificate not valid for name ") {
        Some(names) => {
            let names = names.replace("; certificate is", ", but is").replace("DnsName(", "").replace("IpAddress(", "");
            let names = names.replace(')', "").replace('"', "`");
            (
                format!("is not for {names}"),
                "name in the certificate the address by which others connect to that machine",
            )
        }
        None => (format!("cannot be used: {fault}"), ONE_AUTHORITY),
    }
}

/// Describes the fault that the other side finds in this machine's certificate, from its TLS alert.
fn fault_of_ours(alert: &str) -> (String, &'static str) {
    let (what_of, hint) = match alert {
        "CertificateRequired" => (
            "it asks for a certificate, and this one shows none",
            "enable_mtls: true, connect_certificate and connect_private_key in the `zenoh` file show one",
        ),
        "CertificateExpired" => (
            "by the clock there its certificate has expired, or is not valid yet",
            "is the clock there right? if it is, give this machine a new certificate",
        ),
        "UnknownCA" | "DecryptError" => ("its certificate is of an authority that is not known there", ONE_AUTHORITY),
        "BadCertificate" => (
            "its certificate is not for the address by which it was reached, or is broken",
            "name in the certificate the address by which others connect",
        ),
        other => return (format!("`{other}`, as TLS calls it"), ONE_AUTHORITY),
    };
    (what_of.to_owned(), hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn what_of(line: &str) -> Option<String> {
        refusal(line).map(|report| report.split("\n  hint: ").next().unwrap().to_owned())
    }

    #[test]
    fn the_report_of_a_failed_handshake_says_who_refuses_whom_and_why() {
        let (begin, end) =
            ("Can not create a new TLS link bound to DnsName(\"a\"): ", " at /root/zenoh/unicast.rs:343.");
        let connecting =
            |fault: &str| format!("Unable to connect to configured peer tls/a:1! {begin}{fault}{end}. Retry");
        let accepting = |fault: &str| format!("{fault}. Hint: increase the system open file limit.");
        let (theirs, alert) = ("invalid peer certificate: ", "received fatal alert: ");
        let name = "certificate not valid for name \"a\"; certificate is only valid for DnsName(\"b\")";
        let (refused_peer, refused_client) = ("refused the machine at `tls/a:1`: ", "refused somebody who connects: ");
        let (refused_by_peer, refused_by_client) =
            ("the machine at `tls/a:1` refuses this machine: ", "somebody who connects refuses this machine: ");
        for (text, prefix, [from, expected]) in [
            ("certificate expired: verification time 1", theirs, [refused_peer, "its certificate has expired"]),
            (
                "UnknownIssuer",
                theirs,
                [refused_peer, "its certificate is of an authority that this machine does not know"],
            ),
            (name, theirs, [refused_peer, "its certificate is not for `a`, but is only valid for `b`"]),
            ("CertificateRequired", alert, [refused_by_peer, "it asks for a certificate, and this one shows none"]),
            ("CertificateUnknown", alert, [refused_by_peer, "`CertificateUnknown`, as TLS calls it"]),
        ] {
            assert_eq!(what_of(&connecting(&format!("{prefix}{text}"))), Some(format!("{from}{expected}")));
        }
        let expired = "by the clock there its certificate has expired, or is not valid yet";
        for (text, prefix, [from, expected]) in [
            ("certificate not valid yet: verification", theirs, [refused_client, "its certificate is not valid yet"]),
            (
                "BadSignature",
                theirs,
                [refused_client, "its certificate is of an authority that this machine does not know"],
            ),
            ("peer sent no certificates", "", [refused_client, "it shows no certificate"]),
            ("UnknownCA", alert, [refused_by_client, "its certificate is of an authority that is not known there"]),
            ("CertificateExpired", alert, [refused_by_client, expired]),
        ] {
            assert_eq!(what_of(&accepting(&format!("{prefix}{text}"))), Some(format!("{from}{expected}")));
        }
        for other in ["Unable to connect to configured peer tcp/a:1! Connection refused", "Try to connect: tls/a:1", ""]
        {
            assert_eq!(what_of(other), None);
        }
    }
}
