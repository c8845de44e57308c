//! Free ports for tests that listen on them later, here and in the tests of the whole program.

use std::net::TcpListener;
use std::sync::atomic::{AtomicU32, Ordering};

/// Returns an unused endpoint on this host, a different one each time. The system takes the ports of connecting sockets from
/// 32768 up; these are below, so that none is taken by chance before a test listens on it.
pub fn loopback() -> String {
    static TAKEN: AtomicU32 = AtomicU32::new(0);
    let next = || 10_000 + (97 * std::process::id() + TAKEN.fetch_add(1, Ordering::Relaxed)) % 22_000;
    let mut ports = std::iter::repeat_with(next).map(|port| port as u16).take(22_000);
    let port = ports.find(|port| TcpListener::bind(("127.0.0.1", *port)).is_ok()).unwrap();
    format!("tcp/127.0.0.1:{port}")
}
