//! The page of `conicflow view`, requested over plain sockets: what it shows of runs and recordings, which requests it refuses,
//! and that many clients, also clients that leave in the middle of an answer, do not affect a run. `browser.rs` tests it in
//! browsers.

use crate::support::{CHECK_PERIOD, DEADLINE, Playground, Started, TRACKING, wait_until};
use serde_json::{Value as Json, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::ChildStdout;
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Arguments of a run that does not end by itself, at a rate that leaves processor time for other programs.
pub const SLOWLY: [&str; 3] = ["run", "--set", "source.rate_hz=30"];
/// Maximum time of an answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(90);

/// A running server of the page.
pub struct Page {
    /// `127.0.0.1:PORT`.
    pub host: String,
    program: Option<(Started, BufReader<ChildStdout>)>,
}

/// An answer of the server.
pub struct Answer {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

/// Sends the unchanged text of a request to `host`, and reads the answer.
pub fn exchange(host: &str, request: &str) -> Answer {
    let mut stream = TcpStream::connect(host).unwrap();
    stream.set_read_timeout(Some(ANSWER_TIMEOUT)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut reader = BufReader::new(stream);
    let (mut head, mut length) = (String::new(), 0);
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).unwrap();
        if line.trim().is_empty() {
            break;
        }
        if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        head.push_str(&line);
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).unwrap();
    Answer { status: head.split(' ').nth(1).unwrap().parse().unwrap(), head, body }
}

impl Answer {
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    /// The JSON text and the pixels of an answer to `/look`.
    fn update(&self) -> (Json, Vec<u16>) {
        assert_eq!(self.status, 200, "{}", self.text());
        let (length, rest) = self.body.split_at(4);
        let length = u32::from_le_bytes(length.try_into().unwrap()) as usize;
        assert!(length.is_multiple_of(4), "the pixels of an answer are aligned");
        let pixels = rest[length..].as_chunks().0.iter().map(|pixel| u16::from_le_bytes(*pixel)).collect();
        (serde_json::from_slice(&rest[..length]).unwrap(), pixels)
    }
}

impl Page {
    /// Starts `conicflow view` with these arguments at a free port, and waits for its address.
    pub fn open(playground: &Playground, arguments: &[&str]) -> Self {
        let arguments = [&["view", "--listen", "127.0.0.1:0"], arguments].concat();
        let (program, mut output) = Started::piped(playground.command(&arguments));
        let mut line = String::new();
        output.read_line(&mut line).unwrap();
        let host = line.trim().strip_prefix("http://").unwrap_or_else(|| panic!("`{line}`: {}", program.stderr()));
        let host = host.split('/').next().unwrap().to_owned();
        Self { host, program: Some((program, output)) }
    }

    /// The page that a stage offers, according to its log.
    pub fn of_stage(log: &str) -> Self {
        let (_, address) = log.split_once("http://").unwrap();
        Self { host: address.split('/').next().unwrap().to_owned(), program: None }
    }

    pub fn url(&self) -> String {
        format!("http://{}/", self.host)
    }

    /// Sends the unchanged text of a request, and reads the answer.
    pub fn send(&self, request: &str) -> Answer {
        exchange(&self.host, request)
    }

    /// Requests a path, as a browser on this machine does.
    pub fn get(&self, path: &str) -> Answer {
        self.send(&format!("GET {path} HTTP/1.1\r\nHost: {}\r\n\r\n", self.host))
    }

    /// Requests, as the browser `name`, the update for a page that already has `frames` frames.
    fn ask_for_update(&self, name: &str, frames: u64) -> (Json, Vec<u16>) {
        self.get(&format!("/look?browser={name}&frames={frames}&columns=32")).update()
    }

    /// The next frame for which `holds` is true.
    pub fn frame(&self, what: &str, mut holds: impl FnMut(&Json) -> bool) -> (Json, Vec<u16>) {
        let mut frames = 0;
        self.wait(what, || {
            let (json, pixels) = self.ask_for_update("test", frames);
            frames = json["frames"].as_u64().unwrap();
            let holds = !json["frame"].is_null() && holds(&json);
            (holds, json, pixels)
        })
    }

    /// The state of the page as soon as `holds` is true for it, with the frame that it shows, which may be an old one.
    pub fn wait_for_state(&self, what: &str, mut holds: impl FnMut(&Json) -> bool) -> (Json, Vec<u16>) {
        self.wait(what, || {
            let (json, pixels) = self.ask_for_update("test", u64::MAX);
            (holds(&json), json, pixels)
        })
    }

    /// Sends requests until an answer is as expected. Panics with the last answer if none is.
    fn wait(&self, what: &str, mut ask: impl FnMut() -> (bool, Json, Vec<u16>)) -> (Json, Vec<u16>) {
        let since = Instant::now();
        loop {
            let (holds, json, pixels) = ask();
            if holds {
                return (json, pixels);
            }
            assert!(since.elapsed() < DEADLINE, "the page never showed {what}, but at last {json}");
            sleep(CHECK_PERIOD);
        }
    }

    /// Sends a command, and returns the status of the answer.
    pub fn send_command(&self, command: &Json) -> u16 {
        let (host, body) = (&self.host, command.to_string());
        let head = format!(
            "POST /command HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nContent-Type: application/json"
        );
        self.send(&format!("{head}\r\nContent-Length: {}\r\n\r\n{body}", body.len())).status
    }
}

pub fn items(json: &Json) -> &[Json] {
    json["frame"]["items"].as_array().map_or(&[], Vec::as_slice)
}

#[test]
fn a_live_run_is_shown_and_waited_for_before_and_after() {
    let playground = Playground::with_pipeline(TRACKING);
    let page = Page::open(&playground, &[]);
    let (waiting, _) = page.ask_for_update("test", 0);
    assert!(waiting["frame"].is_null() && waiting["about"]["notice"].as_str().unwrap().contains("no pipeline runs"));

    let run = playground.start(&SLOWLY);
    let (json, pixels) = page.frame("a frame with tracks", |json| !items(json).is_empty());
    let frame = &json["frame"];
    assert_eq!((frame["kind"].as_str(), frame["image"]["columns"].as_u64()), (Some("tracks"), Some(32)));
    assert_eq!(pixels.len(), 32 * 24, "every second pixel of every second row of 64x48");
    assert!(pixels.iter().filter(|pixel| **pixel > 0).count() > 300, "most of them measure something");
    let track = &items(&json)[0];
    assert!(track["id"].is_u64() && track["sigma"]["radius"].as_f64().unwrap() > 0.0, "{track}");
    assert!(!track["seen"].as_array().unwrap().is_empty(), "it has an outline: {track}");

    // The server sends the graph and the counts once a second.
    let (json, _) = page.wait_for_state("the graph", |json| !json["about"]["graph"].is_null());
    let graph = &json["about"]["graph"];
    assert_eq!((graph["stages"].as_array().unwrap().len(), json["about"]["title"].as_str()), (5, Some("tracking")));
    let stages = graph["activity"]["stages"].as_array().unwrap();
    assert!(stages.iter().any(|stage| !stage["counters"].as_object().unwrap().is_empty()), "{stages:?}");

    drop(run);
    page.wait_for_state("that the run is over", |json| {
        json["about"]["notice"].as_str().is_some_and(|notice| notice.contains("no pipeline runs"))
    });
}

#[test]
fn several_pipelines_are_offered_and_the_user_can_choose_another() {
    let playground = Playground::with_pipeline(TRACKING);
    playground
        .write("second.toml", &TRACKING.replace("\"tracking\"", "\"second\"").replace("tracks.jsonl", "second.jsonl"));
    let _first = playground.start(&SLOWLY);
    let page = Page::open(&playground, &["--pipeline", "tracking"]);
    page.wait_for_state("the first", |json| json["about"]["pipelines"] == json!(["tracking"]));
    let _second = playground.start(&["run", "second.toml", "--set", "source.rate_hz=30"]);
    let both = json!(["second", "tracking"]);
    let (json, _) = page.wait_for_state("both", |json| json["about"]["pipelines"] == both);
    assert_eq!(json["about"]["title"], "tracking");
    assert_eq!(page.send_command(&json!({ "do": "pipeline", "name": "second" })), 204);
    page.frame("the other one", |json| json["about"]["title"] == "second" && !items(json).is_empty());
}

#[test]
fn requests_from_other_sites_are_refused_and_malformed_ones_are_reported() {
    let playground = Playground::new();
    let page = Page::open(&playground, &[]);
    let own = page.host.clone();
    let status = |request: &str| page.send(request).status;
    assert_eq!(page.get("/").status, 200);
    assert!(page.get("/").head.contains("Content-Security-Policy: default-src 'none'"));
    assert_eq!(status("GET / HTTP/1.1\r\nHost: robot.example\r\n\r\n"), 403, "a name that leads here");
    assert_eq!(
        status(&format!("GET /look?browser=a HTTP/1.1\r\nHost: {own}\r\nOrigin: http://robot.example\r\n\r\n")),
        403
    );
    assert_eq!(status(&format!("GET /../Cargo.toml HTTP/1.1\r\nHost: {own}\r\n\r\n")), 404);
    assert_eq!(status(&format!("GET /etc/passwd HTTP/1.1\r\nHost: {own}\r\n\r\n")), 404);
    assert_eq!(status(&format!("DELETE / HTTP/1.1\r\nHost: {own}\r\n\r\n")), 405);
    assert_eq!(status(&format!("GET /look HTTP/1.1\r\nHost: {own}\r\n\r\n")), 400, "a browser without a name");
    assert_eq!(status("rubbish\r\n\r\n"), 400);
    assert_eq!(status(&format!("GET / HTTP/1.1\r\nHost: {own}\r\nHost: robot.example\r\n\r\n")), 400, "two names");
    assert_eq!(status(&format!("GET /{} HTTP/1.1\r\n", "a".repeat(9000))), 431);
    assert_eq!(page.send_command(&json!({ "do": "stop" })), 400);
    let post = format!("POST /command HTTP/1.1\r\nHost: {own}\r\n");
    assert_eq!(status(&format!("{post}Content-Length: 2\r\n\r\n{{}}")), 415, "a form of another page");
    assert_eq!(status(&format!("{post}Content-Type: application/json\r\nContent-Length: 999999999\r\n\r\n")), 413);
}

#[test]
fn other_machines_need_the_token() {
    let playground = Playground::new();
    let (mut program, mut output) = Started::piped(playground.command(&["view", "--listen", "0.0.0.0:0"]));
    let mut line = String::new();
    output.read_line(&mut line).unwrap();
    let (address, token) = line.trim().split_once("/?token=").unwrap();
    assert_eq!(token.len(), 32, "{line}");
    let port = address.rsplit_once(':').unwrap().1;
    let page = Page { host: format!("127.0.0.1:{port}"), program: None };
    assert_eq!((page.get("/").status, page.get("/look?browser=a").status), (401, 401));
    assert_eq!(page.get(&format!("/?token={}", "0".repeat(32))).status, 401);
    let entered = page.get(&format!("/?token={token}"));
    assert_eq!(entered.status, 303);
    let cookie = entered.head.lines().find_map(|line| line.strip_prefix("Set-Cookie: ")).unwrap();
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"), "{cookie}");
    let cookie = cookie.split(';').next().unwrap();
    let with = format!("GET / HTTP/1.1\r\nHost: 192.168.7.7:{port}\r\nCookie: {cookie}\r\n\r\n");
    assert_eq!(page.send(&with).status, 200);
    program.wait_until("it is at work", || true);

    let refused = playground.conicflow(&["view", "--listen", "0.0.0.0:0", "--token", "short"]).expect_code(2);
    refused.expect_texts(&["the token is not at least 12 letters"]);
    let refused = playground.conicflow(&["view", "--listen", &format!("127.0.0.1:{port}")]).expect_code(2);
    refused.expect_texts(&["another program is there"]);
}

#[test]
fn a_hundred_browsers_and_broken_connections_cost_the_run_nothing() {
    const FRAMES: &str = "240";
    let playground = Playground::with_pipeline(TRACKING);
    let page = Page::open(&playground, &[]);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=60", "--frames", FRAMES]);
    run.wait_until("it delivers", || !playground.lines("tracks.jsonl").is_empty());
    // Half of the clients send requests, and never read the answers. They stay connected until the run has ended.
    let silent: Vec<_> = (0..50)
        .map(|number| {
            let mut stream = TcpStream::connect(&page.host).unwrap();
            let request = format!("GET /look?browser=s{number}&columns=1280 HTTP/1.1\r\nHost: {}\r\n\r\n", page.host);
            stream.write_all(request.repeat(4).as_bytes()).ok();
            stream
        })
        .collect();
    let mut refused = 0;
    for number in 0..50 {
        let mut stream = TcpStream::connect(&page.host).unwrap();
        stream.set_read_timeout(Some(ANSWER_TIMEOUT)).unwrap();
        write!(stream, "GET /look?browser=l{number} HTTP/1.1\r\nHost: {}\r\n\r\n", page.host).ok();
        let mut begin = [0; 12];
        // The client leaves after twelve bytes, which is in the middle of the answer.
        if stream.read_exact(&mut begin).is_ok() && begin.ends_with(b"503") {
            refused += 1;
        }
    }
    assert!(refused > 0, "there is room for so many only, and the others are told");
    let ended = run.wait().expect_code(0);
    drop(silent);
    assert_eq!(playground.sequences("tracks.jsonl"), (0..FRAMES.parse().unwrap()).collect::<Vec<u64>>());
    assert_eq!(ended.input("depth", "extractor").dropped + ended.input("tracks", "json").dropped, 0);
    // The server also serves clients that connect later.
    wait_until("a browser is served again", || page.get("/look?browser=late").status == 200);
}

/// Runs a pipeline that records all its topics.
pub fn recording(playground: &Playground, frames: &str) {
    let recorder = "[stage.recorder]\nnode = \"mcap_sink\"\ninput = { topic = \"tracks\", delivery = \"lossless\" }\n\
                    inputs = { depth = \"depth\" }\npath = \"run.mcap\"\n";
    playground.write("record.toml", &format!("{TRACKING}\n{recorder}"));
    playground.conicflow(&["run", "record.toml", "--frames", frames]).expect_code(0);
}

#[test]
fn a_recording_is_played_paused_stepped_and_sought() {
    let playground = Playground::new();
    recording(&playground, "90");
    let recorded = playground.json_lines("tracks.jsonl");
    let page = Page::open(&playground, &["run.mcap"]);
    page.frame("it plays by itself", |json| json["frame"]["sequence"].as_u64() > Some(2));
    assert_eq!(page.send_command(&json!({ "do": "pause" })), 204);
    let at =
        |sequence: u64| move |json: &Json| json["frame"]["sequence"] == sequence && json["player"]["plays"] == false;
    // The recording has 30 frames per second, and the first frame is at time 0.
    assert_eq!(page.send_command(&json!({ "do": "seek", "at_s": 1.99 })), 204);
    let (json, pixels) = page.frame("the frame at two seconds", at(60));
    assert_eq!(pixels.len(), 32 * 24);
    let ids = |items: &[Json]| items.iter().map(|item| item["id"].clone()).collect::<Vec<_>>();
    let expected = recorded[60]["tracks"].as_array().unwrap();
    assert_eq!(ids(items(&json)), ids(expected), "the tracks of this frame");
    assert_eq!(items(&json)[0]["center"], expected[0]["center"]);
    let length_s = json["player"]["length_s"].as_f64().unwrap();
    assert!((length_s - 89.0 / 30.0).abs() < 1e-3, "{length_s}");
    for (by, sequence) in [(-1, 59), (-1, 58), (1, 59), (3, 62), (-60, 2), (-1_000_000, 0), (1, 1), (500, 89)] {
        assert_eq!(page.send_command(&json!({ "do": "step", "by": by })), 204);
        page.frame("the frame that was stepped to", at(sequence));
    }
    page.send_command(&json!({ "do": "seek", "at_s": 1e300 }));
    page.frame("the last", at(89));
    page.send_command(&json!({ "do": "speed", "factor": 10.0 }));
    page.send_command(&json!({ "do": "play" }));
    page.wait_for_state("it plays again from the beginning, to its end", at(89));
}

#[test]
fn a_recording_that_ends_in_the_middle_and_one_of_depth_alone_are_shown() {
    let playground = Playground::new();
    recording(&playground, "60");
    let whole = std::fs::read(playground.path("run.mcap")).unwrap();
    std::fs::write(playground.path("torn.mcap"), &whole[..whole.len() * 3 / 4]).unwrap();
    let page = Page::open(&playground, &["torn.mcap"]);
    page.send_command(&json!({ "do": "seek", "at_s": 0.3 }));
    page.send_command(&json!({ "do": "pause" }));
    page.send_command(&json!({ "do": "step", "by": -1 }));
    page.frame("a frame of the part that is there", |json| {
        json["player"]["plays"] == false && !items(json).is_empty() && json["frame"]["sequence"].as_u64() < Some(30)
    });

    let recorder = "[stage.recorder]\nnode = \"mcap_sink\"\ninput = { topic = \"depth\", delivery = \"lossless\" }\n\
                    path = \"depth.mcap\"\n";
    let source = TRACKING.split("[stage.extractor]").next().unwrap();
    playground.write("depth.toml", &format!("{source}\n{recorder}"));
    playground.conicflow(&["run", "depth.toml", "--frames", "5"]).expect_code(0);
    let page = Page::open(&playground, &["depth.mcap"]);
    let (json, pixels) = page.frame("depth alone", |_| true);
    assert!(json["frame"]["kind"].is_null() && !pixels.is_empty());
    assert!(json["about"]["notice"].as_str().unwrap().contains("depth images alone"));

    let refused = playground.conicflow(&["view", "none.mcap"]).expect_code(2);
    refused.expect_texts(&["there is no recording `none.mcap`", "hint: name an MCAP file"]);
}

#[test]
fn a_damaged_place_in_a_recording_ends_neither_the_page_nor_a_run() {
    let playground = Playground::new();
    recording(&playground, "400");
    let mut bytes = std::fs::read(playground.path("run.mcap")).unwrap();
    // A chunk in the middle is overwritten, except its head.
    let (mut at, mut chunks) = (8, Vec::new());
    while at + 9 < bytes.len() {
        let end = at + 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        chunks.extend((bytes[at] == 0x06).then_some(at + 80..end));
        at = end;
    }
    assert!(chunks.len() > 2, "{chunks:?}");
    bytes[chunks[chunks.len() / 2].clone()].fill(0xff);
    std::fs::write(playground.path("damaged.mcap"), bytes).unwrap();

    let page = Page::open(&playground, &["damaged.mcap"]);
    page.send_command(&json!({ "do": "speed", "factor": 10.0 }));
    let shows =
        |sequence: u64| move |json: &Json| json["frame"]["sequence"] == sequence && json["player"]["plays"] == false;
    page.wait_for_state("the last frame, behind the damage", shows(399));
    for at_s in [12.0, 9.0, 6.5, 5.0, 3.0] {
        page.send_command(&json!({ "do": "seek", "at_s": at_s }));
        page.send_command(&json!({ "do": "step", "by": -1 }));
    }
    page.send_command(&json!({ "do": "seek", "at_s": 0.0 }));
    page.wait_for_state("the first frame", shows(0));
    let log = page.program.as_ref().unwrap().0.stderr();
    assert_eq!(log.matches("is damaged (").count(), 1, "{log}");
    let found = playground.conicflow(&["detect", "damaged.mcap"]).expect_code(0);
    found.expect_texts(&["is damaged", "; damaged places: 1"]);
    assert!(found.stdout.lines().count() > 20, "{}", found.stdout);
}

#[test]
fn a_sink_shows_the_run_that_it_is_part_of() {
    let playground = Playground::new();
    let sink = "[stage.page]\nnode = \"view_sink\"\ninput = \"tracks\"\ninputs = { depth = \"depth\" }\n\
                listen = \"127.0.0.1:0\"\n";
    playground.write("pipeline.toml", &format!("{TRACKING}\n{sink}"));
    let mut run = playground.start(&SLOWLY);
    run.wait_for_text("in a browser");
    let page = Page::of_stage(&run.stderr());
    let (json, pixels) = page.frame("a frame with tracks", |json| !items(json).is_empty());
    assert!(pixels.len() == 32 * 24 && json["frame"]["latency_ms"].as_f64().is_some());
    let (json, _) = page.wait_for_state("the graph", |json| !json["about"]["graph"].is_null());
    assert_eq!(json["about"]["graph"]["stages"].as_array().unwrap().len(), 6);
}
