//! Ports for tests that listen at one later, here and in those of the whole program.

use std::net::TcpListener;
use std::sync::atomic::{AtomicU32, Ordering};

/// An endpoint on this host that nobody uses, each time another one. Who connects has a port that the system chooses, from 32768
/// on: these are below, so that nobody takes one by chance before it is listened at.
pub fn loopback() -> String {
    static TAKEN: AtomicU32 = AtomicU32::new(0);
    let next = || 10_000 + (97 * std::process::id() + TAKEN.fetch_add(1, Ordering::Relaxed)) % 22_000;
    let mut ports = std::iter::repeat_with(next).map(|port| port as u16).take(22_000);
    let port = ports.find(|port| TcpListener::bind(("127.0.0.1", *port)).is_ok()).unwrap();
    format!("tcp/127.0.0.1:{port}")
}
