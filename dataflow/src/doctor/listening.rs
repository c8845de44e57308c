//! Checks the endpoints of a pipeline: the ports that it listens on, the hosts that it connects to, and the address of its
//! metrics.

use super::finding::Finding;
use crate::network::{BridgePlan, Network};
use crate::pipeline::{check_host, split_endpoint};
use crate::plan::{Plan, Runs};
use conicflow_messages::Hinted;
use std::io::{self, ErrorKind};
use std::net::{SocketAddr, TcpListener, UdpSocket};

/// Reports ports that these plans need and that cannot be bound. Addresses of other machines are not checked.
pub(super) fn examine(plans: &[&Plan], network: &Network) -> Vec<Finding> {
    let endpoints = bridges(plans).flat_map(|bridge| match (network.listen_endpoints)(&bridge.settings) {
        Ok(endpoints) => endpoints.into_iter().map(|endpoint| Ok((bridge.machine.clone(), endpoint))).collect(),
        Err(fault) => vec![Err(fault)],
    });
    let found = endpoints.filter_map(|endpoint| match endpoint {
        Ok((machine, endpoint)) => taken(&machine, &endpoint).map(Finding::from),
        Err(fault) => Some(fault.into()),
    });
    found.collect()
}

/// Warns of problems that may prevent the links of these plans' machines.
pub(super) fn warnings(plans: &[&Plan], network: &Network) -> Vec<Finding> {
    let warnings = bridges(plans).flat_map(|bridge| {
        let warning = |Hinted { what, hint, .. }| Hinted::new(format!("machine `{}`: {what}", bridge.machine), hint);
        let hosts = bridge.settings.connect.iter().filter_map(|endpoint| check_host(endpoint).err());
        (network.warnings)(&bridge.settings).into_iter().chain(hosts).map(warning)
    });
    warnings.map(Finding::from).collect()
}

fn bridges<'a>(plans: &[&'a Plan]) -> impl Iterator<Item = &'a BridgePlan> {
    plans.iter().flat_map(|plan| &plan.stages).filter_map(|stage| match &stage.runs {
        Runs::Bridge(bridge) => Some(&**bridge),
        _ => None,
    })
}

fn taken(machine: &str, endpoint: &str) -> Option<Hinted> {
    let (protocol, address) = split_endpoint(endpoint)?;
    let error = bind(protocol, address).err()?;
    Some(Hinted::new(format!("machine `{machine}` cannot listen on `{endpoint}`: {error}"), hint(&error, address)?))
}

/// Reports that the metrics of a run cannot be served at this address; `is_own`: whether it has to be an address of this machine.
pub(super) fn metrics(address: SocketAddr, is_own: bool) -> Option<Finding> {
    let error = TcpListener::bind(address).err()?;
    let what = format!("`metrics` of the pipeline file: nothing can be offered at {address}: {error}");
    let no_address = || is_own.then(|| "`ip address` lists the addresses that this machine has now".to_owned());
    Some(Hinted::new(what, hint(&error, &address.to_string()).or_else(no_address)?).into())
}

/// Hint for a port of this machine; `None` if the address belongs to another one.
fn hint(error: &io::Error, address: &str) -> Option<String> {
    let port = address.rsplit(':').next().unwrap_or(address);
    match error.kind() {
        ErrorKind::AddrInUse => {
            Some(format!("`ss -lnp sport = :{port}` shows who has it; end that, or choose another port"))
        }
        ErrorKind::PermissionDenied => Some("choose a port above 1023".to_owned()),
        _ => None,
    }
}

fn bind(protocol: &str, address: &str) -> io::Result<()> {
    match protocol {
        "udp" | "quic" => UdpSocket::bind(address).map(drop),
        "tcp" | "tls" | "ws" => TcpListener::bind(address).map(drop),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::until;

    #[test]
    fn a_port_that_somebody_has_is_told() {
        let holder = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("tcp/{}", holder.local_addr().unwrap());
        let finding = taken("robot", &endpoint).unwrap();
        assert!(finding.what.starts_with(&format!("machine `robot` cannot listen on `{endpoint}`: ")), "{finding}");
        assert!(finding.hint.contains("choose another port"), "{finding}");
        drop(holder);
        // Processes that other tests fork hold a copy of the socket until they exec.
        assert!(until(|| taken("robot", &endpoint).is_none()));
    }

    #[test]
    fn metrics_of_this_machine_need_an_address_that_it_has() {
        let of_another: SocketAddr = "192.0.2.1:9464".parse().unwrap();
        assert!(metrics(of_another, false).is_none());
        assert!(metrics(of_another, true).unwrap().to_string().contains("`ip address`"));
        assert!(metrics("127.0.0.1:0".parse().unwrap(), true).is_none());
    }

    #[test]
    fn the_address_of_another_machine_tells_nothing() {
        assert_eq!(taken("robot", "tcp/192.0.2.1:7447"), None);
        assert_eq!(taken("robot", "unixsock-stream/tmp/socket"), None);
    }
}
