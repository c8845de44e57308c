//! A Zenoh router that listens on the endpoints of its command line until it is killed.

use zenoh::Wait;

fn main() -> zenoh::Result<()> {
    let endpoints: Vec<String> = std::env::args().skip(1).collect();
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\""),
        ("scouting/multicast/enabled", "false"),
        ("listen/endpoints", &format!("{endpoints:?}")),
        ("connect/endpoints", "[]"),
    ] {
        config.insert_json5(key, value)?;
    }
    let _router = zenoh::open(config).wait()?;
    loop {
        std::thread::park();
    }
}
