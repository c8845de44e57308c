//! Builds the Zenoh configuration of a machine from its table. The configuration is closed unless the file opens it.

use crate::certificates;
use crate::wire::MAX_MESSAGE;
use conicflow_dataflow::pipeline::{Machine, check_endpoint, split_endpoint};
use conicflow_dataflow::{Hinted, LinkKey};
use rustls::pki_types::UnixTime;
use serde_json::{Value as Json, json};
use std::path::Path;

/// A link is given up after this silence; until then it recovers by itself.
const LEASE_MS: u64 = 2000;
/// How long a frame may wait on a slow link, in microseconds, before Zenoh drops it.
const MAX_FRAME_WAIT_US: u64 = 1_000_000;
/// Largest message of ROS 2, in bytes: a point cloud of 1280x720 has 30 million.
const MAX_CLOUD: usize = 64 << 20;

/// Checks that a machine's table can be used; a missing file is reported elsewhere.
pub(crate) fn check(machine: &Machine) -> Result<(), Hinted> {
    machine.key.as_ref().filter(|file| file.is_file()).map_or(Ok(()), |file| LinkKey::read(file).map(drop))?;
    if is_missing(machine) { Ok(()) } else { configurations(machine).map(drop) }
}

/// Returns reasons why a machine with a valid table may get no links: faults of its certificates at the present time.
pub(crate) fn warnings(machine: &Machine) -> Vec<Hinted> {
    let settings = if is_missing(machine) { Ok(Json::Null) } else { settings(machine) };
    settings.map(|settings| certificates::warnings(tls(&settings), UnixTime::now())).unwrap_or_default()
}

fn is_missing(machine: &Machine) -> bool {
    machine.zenoh.as_ref().is_some_and(|file| !file.is_file())
}

fn tls(settings: &Json) -> &Json {
    &settings["transport"]["link"]["tls"]
}

/// Returns the secret that authenticates messages between machines: the key in the machine's table; else this user's own key, if
/// all endpoints are on this host and neither certificates nor `insecure` are set; else none.
pub(super) fn key(machine: &Machine) -> Result<Option<LinkKey>, Hinted> {
    if let Some(file) = &machine.key {
        return LinkKey::read(file).map(Some);
    }
    if is_of_one_user(machine, &settings(machine)?) { LinkKey::of_user().map(Some) } else { Ok(None) }
}

/// Whether all endpoints of a machine are on this host, so that the machines can share the key of its user.
fn is_of_one_user(machine: &Machine, settings: &Json) -> bool {
    let mut endpoints = Vec::new();
    ["listen", "connect"].iter().for_each(|key| collect_strings(&settings[key]["endpoints"], &mut endpoints));
    let is_secure = asks_who(settings) && endpoints.iter().all(|endpoint| is_encrypted(endpoint));
    let meets_anybody = !endpoints.is_empty();
    meets_anybody && !machine.insecure && !is_secure && endpoints.iter().all(|endpoint| is_local(endpoint))
}

fn asks_who(settings: &Json) -> bool {
    tls(settings)["enable_mtls"] == true
}

/// The endpoints that a machine listens on.
pub(crate) fn listen_endpoints(machine: &Machine) -> Result<Vec<String>, Hinted> {
    let mut endpoints = Vec::new();
    collect_strings(&settings(machine)?["listen"]["endpoints"], &mut endpoints);
    Ok(endpoints)
}

/// Returns the Zenoh configurations of a machine's sessions: of the one that carries everything and, if endpoints of both kinds
/// are named, of one for datagrams.
pub(super) fn configurations(machine: &Machine) -> Result<(zenoh::Config, Option<zenoh::Config>), Hinted> {
    let settings = settings(machine)?;
    let mut endpoints = Vec::new();
    collect_strings(&settings["listen"]["endpoints"], &mut endpoints);
    let is_guarded = machine.insecure || machine.key.is_some() || is_of_one_user(machine, &settings);
    endpoints.iter().try_for_each(|endpoint| check_listen(endpoint, asks_who(&settings), is_guarded))?;
    collect_strings(&settings["connect"]["endpoints"], &mut endpoints);
    endpoints.iter().try_for_each(|endpoint| check_endpoint(endpoint))?;
    let datagrams = endpoints.iter().filter(|endpoint| carries_datagrams(endpoint)).count();
    if datagrams == 0 || datagrams == endpoints.len() {
        return Ok((configuration(&settings)?, None));
    }
    let only = |wanted: fn(&str) -> bool| {
        let mut settings = settings.clone();
        ["listen", "connect"].iter().for_each(|key| retain_strings(&mut settings[key]["endpoints"], wanted));
        configuration(&settings)
    };
    Ok((only(|endpoint| !carries_datagrams(endpoint))?, Some(only(carries_datagrams)?)))
}

/// The Zenoh configuration of a client of these routers. A message may be as large as an organised point cloud.
pub(super) fn client(connect: &[String]) -> Result<zenoh::Config, Hinted> {
    connect.iter().try_for_each(|endpoint| check_endpoint(endpoint))?;
    let mut settings = settings(&Machine { connect: connect.to_vec(), ..Machine::default() })?;
    settings["mode"] = json!("client");
    settings["transport"]["link"]["rx"]["max_message_size"] = json!(MAX_CLOUD);
    configuration(&settings)
}

fn configuration(settings: &Json) -> Result<zenoh::Config, Hinted> {
    zenoh::Config::from_json5(&settings.to_string()).map_err(|error| {
        Hinted::new(format!("Zenoh cannot use its settings: {error}"), "endpoints look like tcp/192.168.0.2:7447")
    })
}

/// Whether a session is a client: it has a single link, to a router.
pub(super) fn is_client(config: &zenoh::Config) -> bool {
    config.get_json("mode").is_ok_and(|mode| mode == "\"client\"")
}

/// Whether an endpoint is unreliable: lost messages do not delay later ones.
fn carries_datagrams(endpoint: &str) -> bool {
    let metadata = endpoint.split('#').next().and_then(|locator| locator.split_once('?')).map_or("", |(_, text)| text);
    match metadata.split(';').find_map(|entry| entry.strip_prefix("rel=")) {
        Some(reliable) => reliable == "0",
        None => endpoint.starts_with("udp/"),
    }
}

fn settings(machine: &Machine) -> Result<Json, Hinted> {
    let mut settings = json!({
        "mode": "peer",
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "listen": { "endpoints": machine.listen },
        "connect": {
            "endpoints": machine.connect,
            "retry": { "period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2 },
        },
        "transport": {
            "unicast": { "open_timeout": LEASE_MS, "accept_timeout": LEASE_MS },
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "queue": { "congestion_control": { "drop": { "max_wait_before_drop_fragments": MAX_FRAME_WAIT_US } } },
                },
                "rx": { "max_message_size": MAX_MESSAGE },
            },
        },
    });
    if let Some(path) = &machine.zenoh {
        merge(&mut settings, read_file(path)?);
    }
    Ok(settings)
}

fn read_file(path: &Path) -> Result<Json, Hinted> {
    let hint = "it is a Zenoh configuration in JSON5, such as { mode: \"client\" }";
    let text = std::fs::read_to_string(path)
        .map_err(|error| Hinted::new(format!("cannot read `{}`: {error}", path.display()), hint))?;
    let mut settings: Json = json5::from_str(&text)
        .map_err(|error| Hinted::new(format!("cannot understand `{}`: {error}", path.display()), hint))?;
    let folder = path.parent().unwrap_or(Path::new("."));
    if let Some(Json::Object(tls)) = settings.pointer_mut("/transport/link/tls") {
        let files = tls.iter_mut().filter(|(key, _)| key.ends_with("_certificate") || key.ends_with("_key"));
        for (_, value) in files {
            if let Some(file) = value.as_str() {
                *value = folder.join(file).to_string_lossy().into();
            }
        }
    }
    Ok(settings)
}

/// Overrides the settings that `more` names; the rest stays.
fn merge(settings: &mut Json, more: Json) {
    match (settings, more) {
        (Json::Object(settings), Json::Object(more)) => {
            more.into_iter().for_each(|(key, value)| merge(settings.entry(key).or_insert(Json::Null), value));
        }
        (settings, more) => *settings = more,
    }
}

/// Collects all strings in a value: endpoints are a list, or one list per mode.
fn collect_strings(value: &Json, strings: &mut Vec<String>) {
    match value {
        Json::String(text) => strings.push(text.clone()),
        Json::Array(values) => values.iter().for_each(|value| collect_strings(value, strings)),
        Json::Object(entries) => entries.values().for_each(|value| collect_strings(value, strings)),
        _ => {}
    }
}

/// Removes the unwanted strings anywhere in a value.
fn retain_strings(value: &mut Json, wanted: fn(&str) -> bool) {
    match value {
        Json::Array(values) => {
            values.retain(|value| value.as_str().is_none_or(wanted));
            values.iter_mut().for_each(|value| retain_strings(value, wanted));
        }
        Json::Object(entries) => entries.values_mut().for_each(|value| retain_strings(value, wanted)),
        _ => {}
    }
}

/// Whether only users of this host can reach it.
fn is_local(endpoint: &str) -> bool {
    let loopbacks = ["127.", "[::1]", "localhost:"];
    split_endpoint(endpoint).is_some_and(|(_, host)| loopbacks.iter().any(|loopback| host.starts_with(loopback)))
}

fn is_encrypted(endpoint: &str) -> bool {
    split_endpoint(endpoint).is_some_and(|(protocol, _)| matches!(protocol, "tls" | "quic"))
}

/// Checks an endpoint to listen on. It has to ask for certificates, unless messages are authenticated or the file says `insecure`
/// (`is_guarded`).
fn check_listen(endpoint: &str, asks_who: bool, is_guarded: bool) -> Result<(), Hinted> {
    if split_endpoint(endpoint).is_none() {
        let hint = "an endpoint looks like tcp/127.0.0.1:7447";
        return Err(Hinted::new(format!("`{endpoint}` is not an endpoint to listen on"), hint));
    }
    if is_guarded || (is_encrypted(endpoint) && asks_who) {
        return Ok(());
    }
    let who = if is_local(endpoint) { "all users of this host" } else { "everyone who can reach it" };
    let hint = if is_encrypted(endpoint) {
        "ask for the others' certificates, with enable_mtls: true under transport.link.tls in the `zenoh` file, or name a `key` \
         that `conicflow key` makes, or say insecure = true"
    } else {
        "name a `key` that `conicflow key` makes, or use tls/.. with certificates in a `zenoh` file, or say insecure = true"
    };
    Err(Hinted::new(format!("`{endpoint}` would be open to {who}"), hint))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listening(endpoint: &str) -> Machine {
        Machine { listen: vec![endpoint.to_owned()], ..Machine::default() }
    }

    #[test]
    fn no_port_is_open_unless_the_file_says_so() {
        let config = configurations(&Machine::default()).unwrap().0;
        for (key, expected) in [
            ("listen/endpoints", "[]"),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/enabled", "false"),
            ("transport/link/rx/max_message_size", "8388608"),
        ] {
            assert_eq!(config.get_json(key).unwrap(), expected, "{key}");
        }
    }

    #[test]
    fn a_client_of_a_router_listens_nowhere() {
        let config = client(&["tcp/robot:7447".to_owned()]).unwrap();
        for (key, expected) in [
            ("mode", "\"client\""),
            ("listen/endpoints", "[]"),
            ("connect/endpoints", r#"["tcp/robot:7447"]"#),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/enabled", "false"),
        ] {
            assert_eq!(config.get_json(key).unwrap(), expected, "{key}");
        }
        assert!(is_client(&config) && !is_client(&configurations(&Machine::default()).unwrap().0));
        assert!(client(&["robot:7447".to_owned()]).is_err());
    }

    #[test]
    fn an_open_port_without_a_key_has_to_be_requested() {
        for closed in ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tls/localhost:7447", "tcp/localhost:7447"] {
            assert_eq!(check(&listening(closed)), Ok(()), "{closed}");
        }
        for open in ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/robot.local:7447", "tls/0.0.0.0:7447", "quic/[::]:7447"]
        {
            assert!(check(&listening(open)).unwrap_err().what.contains("open to everyone"), "{open}");
            assert_eq!(check(&Machine { insecure: true, ..listening(open) }), Ok(()), "{open}");
        }
        assert!(check(&listening("7447")).is_err());
    }

    #[test]
    fn a_key_guards_any_port_and_must_be_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("robot.key");
        let machine = Machine { key: Some(path.clone()), ..listening("tcp/0.0.0.0:7447") };
        assert_eq!(check(&machine), Ok(()), "that there is no such file is told elsewhere");
        assert!(key(&machine).unwrap_err().what.contains("cannot read the key"));
        LinkKey::make(&path).unwrap();
        assert_eq!((check(&machine), key(&machine)), (Ok(()), Ok(Some(LinkKey::read(&path).unwrap()))));
        std::fs::write(&path, "secret").unwrap();
        assert!(check(&machine).unwrap_err().what.contains("is no key"));
    }

    #[test]
    fn the_users_own_key_is_for_machines_that_are_this_host_and_share_nothing_else() {
        let file = tempfile::Builder::new().suffix(".json5").tempfile().unwrap();
        std::fs::write(file.path(), "{ transport: { link: { tls: { enable_mtls: true } } } }").unwrap();
        let is_own = |machine: &Machine| is_of_one_user(machine, &settings(machine).unwrap());
        for endpoint in ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447", "tls/localhost:7447"] {
            let connecting = Machine { connect: vec![endpoint.to_owned()], ..Machine::default() };
            for machine in [listening(endpoint), connecting] {
                assert!(is_own(&machine), "{endpoint}");
                assert!(!is_own(&Machine { insecure: true, ..machine.clone() }), "{endpoint}");
                let with_certificates = Machine { zenoh: Some(file.path().to_owned()), ..machine };
                assert_eq!(is_own(&with_certificates), !endpoint.starts_with("tls/"), "{endpoint}");
            }
        }
        let mixed = Machine { connect: vec!["tcp/192.168.0.2:7447".to_owned()], ..listening("tcp/127.0.0.1:7447") };
        assert!(!is_own(&mixed));
        let refused = check(&mixed).unwrap_err().what;
        assert_eq!(refused, "`tcp/127.0.0.1:7447` would be open to all users of this host");
        assert_eq!(key(&Machine { insecure: true, ..mixed }), Ok(None));
    }

    #[test]
    fn datagrams_have_a_session_of_their_own_beside_a_stream() {
        let machine = |connect: &[&str]| Machine {
            listen: vec!["tcp/127.0.0.1:7447".to_owned()],
            connect: connect.iter().map(|&endpoint| endpoint.to_owned()).collect(),
            insecure: true, // access is checked in another test
            ..Machine::default()
        };
        let endpoints = |config: &zenoh::Config| {
            ["listen", "connect"].map(|way| config.get_json(&format!("{way}/endpoints")).unwrap())
        };
        let (streams, datagrams) = configurations(&machine(&["udp/base:7447", "quic/base:7448?rel=0"])).unwrap();
        assert_eq!(endpoints(&streams), [r#"["tcp/127.0.0.1:7447"]"#, "[]"]);
        assert_eq!(endpoints(&datagrams.unwrap()), ["[]", r#"["udp/base:7447","quic/base:7448?rel=0"]"#]);
        for streams_alone in [&[][..], &["tcp/base:7447"], &["udp/base:7447?rel=1"]] {
            assert!(configurations(&machine(streams_alone)).unwrap().1.is_none(), "{streams_alone:?}");
        }
        let datagrams_alone = Machine { listen: Vec::new(), ..machine(&["udp/base:7447"]) };
        assert!(configurations(&datagrams_alone).unwrap().1.is_none());
    }

    #[test]
    fn endpoints_that_are_not_wanted_are_left_out_of_lists_of_each_mode() {
        let mut endpoints = json!({ "peer": ["tcp/base:7447", "udp/base:7447"], "client": ["udp/base:7448"] });
        retain_strings(&mut endpoints, |endpoint| !carries_datagrams(endpoint));
        assert_eq!(endpoints, json!({ "peer": ["tcp/base:7447"], "client": [] }));
    }

    #[test]
    fn certificates_and_keys_lie_beside_the_file_that_names_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("zenoh.json5");
        let tls = "{ enable_mtls: true, listen_certificate: 'robot.pem', listen_private_key: '/etc/robot.key' }";
        std::fs::write(&path, format!("{{ transport: {{ link: {{ tls: {tls} }} }} }}")).unwrap();
        let read = read_file(&path).unwrap();
        let tls = &read["transport"]["link"]["tls"];
        assert_eq!(tls["listen_certificate"], folder.path().join("robot.pem").to_string_lossy().as_ref());
        assert_eq!((&tls["listen_private_key"], &tls["enable_mtls"]), (&json!("/etc/robot.key"), &json!(true)));
    }

    #[test]
    fn a_zenoh_file_adds_to_the_safe_settings_and_cannot_open_a_port_unnoticed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("zenoh.json5");
        let machine = Machine { zenoh: Some(path.clone()), ..Machine::default() };
        std::fs::write(&path, "{ mode: 'client', connect: { endpoints: ['tcp/router:7447'] }, }").unwrap();
        let config = configurations(&machine).unwrap().0;
        assert_eq!(config.get_json("mode").unwrap(), "\"client\"");
        assert_eq!(config.get_json("scouting/multicast/enabled").unwrap(), "false");
        std::fs::write(&path, "{ listen: { endpoints: { peer: ['tcp/[::]:7447'] } } }").unwrap();
        assert_eq!(listen_endpoints(&machine).unwrap(), ["tcp/[::]:7447"]);
        assert!(check(&machine).unwrap_err().what.contains("`tcp/[::]:7447`"));
        std::fs::write(&path, "{ no_such_key: 1 }").unwrap();
        assert!(check(&machine).is_err());
    }
}
