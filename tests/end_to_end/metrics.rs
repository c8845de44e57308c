//! The metrics of a run: they are read by the parser of Prometheus' own client, compared with `top`, and requested by faulty
//! clients.

use crate::bridge::{apart, loopback, machines, newest, start};
use crate::processes::wait_for_lines;
use crate::support::{Playground, Started, TRACKING, TRACKING_STAGES, python_with};
use crate::view::{Answer, exchange};
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::time::Duration;

/// Maximum time until an answer begins.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// More clients than the server accepts at a time.
const VISITORS: usize = 100;

/// Starts a run that offers metrics at a free port. Returns the run and its address.
fn run(playground: &Playground) -> (Started, String) {
    playground.write("pipeline.toml", &TRACKING.replacen("[stage", "metrics = \"127.0.0.1:0\"\n[stage", 1));
    let mut run = playground.start(&["run", "--set", "source.rate_hz=50"]);
    let host = host(&mut run);
    wait_for_lines(&mut run, playground);
    (run, host)
}

/// The address at which a run says that it offers its metrics.
fn host(run: &mut Started) -> String {
    run.wait_for_text("metrics are at http://");
    let stderr = run.stderr();
    let (_, address) = stderr.split_once("metrics are at http://").unwrap();
    address.split('/').next().unwrap().to_owned()
}

fn get(host: &str) -> Answer {
    get_with(host, "")
}

/// The answer to a request with this further line.
fn get_with(host: &str, line: &str) -> Answer {
    exchange(host, &format!("GET /metrics HTTP/1.1\r\nHost: {host}\r\n{line}Connection: close\r\n\r\n"))
}

/// First line of an answer. A server without room may close the connection before the whole request is sent.
fn first_line(host: &str) -> io::Result<String> {
    let mut stream = TcpStream::connect(host)?;
    stream.set_read_timeout(Some(ANSWER_TIMEOUT))?;
    stream.write_all(format!("GET /metrics HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").as_bytes())?;
    let mut line = String::new();
    BufReader::new(stream).read_line(&mut line)?;
    Ok(line)
}

/// Samples by series, which is a name with labels: the text of the value, and the value.
type Samples = BTreeMap<(String, BTreeMap<String, String>), (String, f64)>;

/// Parses the samples of a text. Without a Python that has the parser, prints that the test is skipped, and returns `None`.
fn parse(text: &str) -> Option<Samples> {
    let python = python_with("prometheus_client", "has no prometheus-client; nothing was shown")?;
    let mut command = Command::new(python);
    command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/end_to_end/metrics.py"));
    let mut parser = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    parser.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    let output = parser.wait_with_output().unwrap();
    assert!(output.status.success(), "{}\n{text}", String::from_utf8_lossy(&output.stderr));
    let lines = String::from_utf8(output.stdout).unwrap();
    let samples = lines.lines().map(|line| serde_json::from_str::<Json>(line).unwrap()).map(|sample| {
        let labels = serde_json::from_value(sample["labels"].clone()).unwrap();
        let name = sample["name"].as_str().unwrap().to_owned();
        ((name, labels), (sample["type"].as_str().unwrap().to_owned(), sample["value"].as_f64().unwrap()))
    });
    Some(samples.collect())
}

fn value(samples: &Samples, name: &str, labels: &[(&str, &str)]) -> f64 {
    let labels = labels.iter().chain(&[("pipeline", "tracking")]).map(|(key, value)| ((*key).into(), (*value).into()));
    let key = (name.to_owned(), labels.collect());
    samples.get(&key).unwrap_or_else(|| panic!("no {key:?} among {:#?}", samples.keys())).1
}

#[test]
fn metrics_equal_the_counts_of_top_by_an_independent_parser() {
    let playground = Playground::new();
    let (run, host) = run(&playground);
    let before = get(&host);
    assert!(
        before.head.to_lowercase().contains("content-type: application/openmetrics-text; version=1.0.0"),
        "{}",
        before.head
    );
    let Some(before) = parse(&before.text()) else { return };
    let top = playground.top();
    let after = parse(&get(&host).text()).unwrap();

    // A count that is read between two others lies between them.
    let between = |name: &str, labels: &[(&str, &str)], shown: &Json| {
        let (low, high, shown) = (value(&before, name, labels), value(&after, name, labels), shown.as_f64().unwrap());
        assert!(low <= shown && shown <= high && high > 0.0, "{name} {labels:?}: {low}, {shown}, {high}");
    };
    for (name, stage) in TRACKING_STAGES.iter().zip(top["stages"].as_array().unwrap()) {
        between("conicflow_frames_total", &[("stage", name)], &stage["messages"]);
        assert_eq!(value(&after, "conicflow_restarts_total", &[("stage", name)]), 0.0);
        let node = stage["node"].as_str().unwrap();
        assert_eq!(value(&after, "conicflow_stage_up", &[("stage", name), ("node", node)]), 1.0);
        let (memory, shown) =
            (value(&after, "conicflow_memory_bytes", &[("stage", name)]), stage["memory_mb"].as_f64().unwrap());
        assert!((0.5..2.0).contains(&(memory / (shown * 1e6))), "{name}: {memory}, {shown} MB");
        let steps = value(&after, "conicflow_step_seconds_bucket", &[("stage", name), ("le", "+Inf")]);
        assert_eq!(steps, value(&after, "conicflow_step_seconds_count", &[("stage", name)]));
        assert!(value(&after, "conicflow_step_seconds_sum", &[("stage", name)]) > 0.0);
    }
    for input in top["inputs"].as_array().unwrap() {
        let edge = [("topic", input["topic"].as_str().unwrap()), ("stage", input["reader"].as_str().unwrap())];
        between("conicflow_received_messages_total", &edge, &input["received"]);
        assert_eq!(value(&after, "conicflow_dropped_messages_total", &edge), 0.0, "{edge:?} is lossless");
        assert!(value(&after, "conicflow_latency_seconds_count", &edge) > 0.0);
        // The median lies in the bucket in which the count passes half of the total.
        let (count, p50) =
            (value(&after, "conicflow_latency_seconds_count", &edge), input["latency_p50_ms"].as_f64().unwrap() * 1e-3);
        let ends = after
            .keys()
            .filter(|(name, labels)| name == "conicflow_latency_seconds_bucket" && labels["stage"] == edge[1].1);
        let below = ends.filter(|(_, labels)| labels["le"].parse::<f64>().unwrap() < p50 / 2.0);
        assert!(below.map(|key| after[key].1).fold(0.0, f64::max) < 0.75 * count, "{edge:?}: {p50}");
    }
    for ((name, labels), (kind, shown)) in &before {
        let is_counted = kind == "counter" || kind == "histogram";
        assert!(!is_counted || after[&(name.clone(), labels.clone())].1 >= *shown, "{name} {labels:?} has gone down");
    }
    run.end();
}

/// Each metric in the queries of the dashboard exists, and the dashboard shows most of the metrics.
#[test]
fn the_dashboard_queries_only_existing_metrics() {
    let playground = Playground::new();
    let (_run, host) = run(&playground);
    let text = get(&host).text();
    let offered = text.lines().filter_map(|line| line.strip_prefix("# TYPE ")).flat_map(|line| {
        let (name, kind) = line.split_once(' ').unwrap();
        let ends = match kind {
            "counter" => &["_total"][..],
            "histogram" => &["_bucket", "_sum", "_count"],
            _ => &[""],
        };
        ends.iter().map(move |end| format!("{name}{end}"))
    });
    let offered: BTreeSet<_> = offered.collect();
    let dashboard = include_str!("../../docs/grafana.json");
    let queried: BTreeSet<_> = dashboard
        .match_indices("conicflow_")
        .map(|(start, _)| {
            dashboard[start..].split(|c: char| !c.is_ascii_alphanumeric() && c != '_').next().unwrap().to_owned()
        })
        .collect();
    assert!(queried.len() > 10 && queried.is_subset(&offered), "{:?} are not told", queried.difference(&offered));
    let panels = serde_json::from_str::<Json>(dashboard).unwrap()["panels"].as_array().unwrap().len();
    assert!(panels >= 8, "{panels} panels");
}

#[test]
fn slow_and_malformed_requests_do_not_delay_the_run() {
    let playground = Playground::new();
    let (mut run, host) = run(&playground);
    // Some clients send half of a request, others read no answer.
    let half = |request: &str| {
        let mut stream = TcpStream::connect(&host).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        stream
    };
    let whole = format!("GET /metrics HTTP/1.1\r\nHost: {host}\r\n\r\n");
    let visitor = |number: usize| half(if number.is_multiple_of(8) { "GET /met" } else { &whole });
    let visitors: Vec<_> = (1..VISITORS).map(visitor).collect();
    let mut last = String::new();
    TcpStream::connect(&host).unwrap().read_to_string(&mut last).unwrap();
    assert!(last.starts_with("HTTP/1.1 503 "), "there is an end to how many are taken: {last}");
    let before = playground.newest("tracks.jsonl");
    run.wait_until("the run goes on", || playground.newest("tracks.jsonl") > before + 20);
    drop(visitors);
    run.wait_until("there is room for others", || first_line(&host).is_ok_and(|line| line.contains(" 200 ")));
    for (request, status) in [
        ("GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        ("POST /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        ("GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n", 403),
        ("GET /metrics HTTP/1.1\r\nHost: localhost\r\nOrigin: http://evil.example\r\n\r\n", 403),
        ("\x16\x03\x01\x02\r\n\r\n", 400),
    ] {
        assert_eq!(exchange(&host, request).status, status, "{request}");
    }
    run.end();
    assert!(TcpStream::connect(&host).is_err(), "the server ends with the run");
}

#[test]
fn an_address_that_is_taken_is_reported_by_doctor_and_before_anything_starts() {
    let playground = Playground::new();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    playground.write("pipeline.toml", &TRACKING.replacen("[stage", &format!("metrics = \"{address}\"\n[stage"), 1));
    let ended = playground.conicflow(&["run"]).expect_code(2);
    let report = format!("`metrics` of the pipeline file: nothing can be offered at {address}: ");
    ended.expect_texts(&[&report, "hint: "]);
    assert!(playground.lines("tracks.jsonl").is_empty());
    let doctor = playground.conicflow(&["doctor"]).expect_code(1);
    assert!(doctor.stdout.contains(&report), "{}", doctor.stdout);
}

#[test]
fn a_token_is_required_and_a_warning_is_given_without_one() {
    const TOKEN: &str = "a-secret-of-ours";
    let with = |metrics: &str| TRACKING.replacen("[stage", &format!("metrics = {metrics}\n[stage"), 1);
    let playground = Playground::with_pipeline(&with(&format!("{{ listen = \"0.0.0.0:0\", token = \"{TOKEN}\" }}")));
    let mut run = playground.start(&["run", "--set", "source.rate_hz=50"]);
    let port = host(&mut run).rsplit(':').next().unwrap().to_owned();
    let host = format!("127.0.0.1:{port}");
    run.wait_until("it is at work", || playground.newest("tracks.jsonl") > 2);
    assert_eq!(get(&host).status, 401);
    assert_eq!(get_with(&host, "Authorization: Bearer another-secret\r\n").status, 401);
    let answer = get_with(&host, &format!("Authorization: Bearer {TOKEN}\r\n"));
    assert!(answer.status == 200 && answer.text().contains("conicflow_frames_total{"), "{}", answer.text());
    let stderr = run.end().stderr;
    assert!(!stderr.contains(TOKEN) && !stderr.contains("may read the metrics"), "{stderr}");

    playground.write("pipeline.toml", &with("\"0.0.0.0:0\""));
    for arguments in [&["validate"][..], &["run", "--frames", "3"]] {
        let ended = playground.conicflow(arguments).expect_code(0);
        let output = ended.stdout + &ended.stderr;
        assert!(output.contains("everyone who reaches 0.0.0.0:0 may read the metrics"), "{output}");
        assert!(output.contains("hint: metrics = { listen = \"0.0.0.0:0\", token = \"..\" }"), "{output}");
    }
    playground.write("pipeline.toml", &with("{ listen = \"127.0.0.1:0\", token = \"short\" }"));
    for command in ["validate", "run"] {
        let errors = playground.conicflow(&[command]).expect_code(2).stderr;
        assert!(errors.contains("`metrics` of the pipeline file: the token is not at least 12 letters"), "{errors}");
    }
}

#[test]
fn each_machine_serves_its_metrics_at_the_address_of_its_table() {
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replacen("[stage", "metrics = \"127.0.0.1:0\"\n[stage", 1);
    let address = loopback()["tcp/".len()..].to_owned();
    let own = format!("[machine.base]\nmetrics = \"{address}\"\n");
    let [robot, base] = machines(&text.replace("[machine.base]\n", &own));
    let mut runs = [start(&robot, "robot"), start(&base, "base")];
    let hosts = runs.each_mut().map(host);
    assert!(hosts[0] != hosts[1] && hosts[1] == address, "{hosts:?}");
    runs[1].wait_until("tracks arrive", || newest(&base) > 30);
    let texts = hosts.map(|host| get(&host).text());
    for (text, [here, away]) in texts.iter().zip([["extractor", "tracker"], ["tracker", "extractor"]]) {
        let has =
            |stage: &str| text.contains(&format!("conicflow_frames_total{{pipeline=\"tracking\",stage=\"{stage}\"}}"));
        assert!(has(here) && !has(away), "{text}");
    }
    drop(runs.map(Started::end));
}
