//! The page in a real browser: headless Chromium, driven by `chromedriver` of the distribution. Where these are missing the tests
//! say so. `CONICFLOW_PICTURES` names a folder for pictures of what was seen.

use crate::compare::{PAPER, SIMULATED};
use crate::support::{Playground, Started, TRACKING, wait_until};
use crate::view::{Page, SLOWLY, exchange, recording};
use serde_json::{Value as Json, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{ChildStdout, Command, Stdio};

/// Without a graphics card, and without a word to the network.
const ARGUMENTS: [&str; 10] = [
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
];

/// A browser that is looked through.
struct Browser {
    port: String,
    session: String,
    _driver: (Started, BufReader<ChildStdout>),
}

impl Browser {
    /// A browser with a window of this size; none where there is no Chromium.
    fn start(width: u32, height: u32) -> Option<Self> {
        let is_there =
            |program: &str| Command::new(program).arg("--version").output().is_ok_and(|told| told.status.success());
        if !is_there("chromedriver") || !(is_there("chromium") || is_there("google-chrome")) {
            eprintln!(
                "SKIPPED: there is no Chromium with `chromedriver`; what a browser makes of the page was not shown"
            );
            return None;
        }
        let mut driver = Command::new("chromedriver");
        driver.args(["--port=0"]);
        let (program, mut output) = Started::piped(driver);
        let mut port = String::new();
        while !port.contains("successfully on port ") {
            port.clear();
            assert!(output.read_line(&mut port).unwrap() > 0, "{}", program.stderr());
        }
        let port = port.trim().trim_end_matches('.').rsplit(' ').next().unwrap().to_owned();
        let mut browser = Self { port, session: String::new(), _driver: (program, output) };
        let size = format!("--window-size={width},{height}");
        let arguments: Vec<_> = ARGUMENTS.into_iter().chain([size.as_str()]).collect();
        let wanted = json!({ "goog:chromeOptions": { "args": arguments }, "goog:loggingPrefs": { "browser": "ALL" } });
        let session = browser.ask("POST", "/session", &json!({ "capabilities": { "alwaysMatch": wanted } }));
        browser.session = format!("/session/{}", session["sessionId"].as_str().unwrap());
        browser.tell("/window/rect", &json!({ "width": width, "height": height }));
        Some(browser)
    }

    /// Asks the driver.
    fn ask(&self, method: &str, path: &str, body: &Json) -> Json {
        let body = if method == "POST" { body.to_string() } else { String::new() };
        let head = format!("{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json");
        let request = format!("{head}\r\nContent-Length: {}\r\n\r\n{body}", body.len());
        let answer = exchange(&format!("127.0.0.1:{}", self.port), &request);
        let answer: Json = serde_json::from_slice(&answer.body).unwrap_or_else(|_| panic!("{}", answer.text()));
        assert!(answer["value"]["error"].is_null(), "{path}: {}", answer["value"]);
        answer["value"].clone()
    }

    fn tell(&self, path: &str, body: &Json) -> Json {
        self.ask("POST", &format!("{}{path}", self.session), body)
    }

    fn visit(&self, page: &Page) {
        self.tell("/url", &json!({ "url": format!("http://{}/", page.host) }));
    }

    /// The value of an expression in the page.
    fn value(&self, expression: &str) -> Json {
        self.tell("/execute/sync", &json!({ "script": format!("return {expression}"), "args": [] }))
    }

    fn wait(&self, what: &str, condition: &str) {
        wait_until(what, || self.value(condition) == true);
    }

    fn click(&self, selector: &str) {
        self.value(&format!("document.querySelector('{selector}').click()"));
    }

    /// Makes sure that the page has nothing to complain of, and keeps a picture of it where that is wanted.
    fn look(&self, name: &str) {
        let log = self.tell("/se/log", &json!({ "type": "browser" }));
        let faults: Vec<_> = log.as_array().unwrap().iter().filter(|entry| entry["level"] == "SEVERE").collect();
        assert!(faults.is_empty(), "{faults:?}");
        let picture = self.ask("GET", &format!("{}/screenshot", self.session), &Json::Null);
        if let Ok(folder) = std::env::var("CONICFLOW_PICTURES") {
            let file = std::fs::File::create(format!("{folder}/{name}.png")).unwrap();
            let mut decoder = Command::new("base64").arg("-d").stdin(Stdio::piped()).stdout(file).spawn().unwrap();
            decoder.stdin.take().unwrap().write_all(picture.as_str().unwrap().as_bytes()).unwrap();
            decoder.wait().unwrap();
        }
    }
}

impl Drop for Browser {
    /// Ends the browser, also after a test that failed; the driver answers when that is done.
    fn drop(&mut self) {
        if let Ok(mut stream) = TcpStream::connect(format!("127.0.0.1:{}", self.port)) {
            write!(stream, "DELETE {} HTTP/1.1\r\nHost: localhost\r\n\r\n", self.session).ok();
            stream.read_exact(&mut [0]).ok();
        }
    }
}

/// How many different colours an image has that was drawn on the page.
const COLOURS: &str = "(() => { const c = document.getElementById('image'); \
    const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer); return new Set(d).size > 50; })()";

#[test]
fn a_browser_shows_a_run_in_the_image_in_space_and_as_stages() {
    let Some(browser) = Browser::start(1400, 1000) else { return };
    let playground = Playground::with_pipeline(TRACKING);
    let _run = playground.start(&SLOWLY);
    let page = Page::open(&playground, &[]);
    browser.visit(&page);
    browser.wait("tracks are listed", "document.querySelectorAll('#list tbody .swatch').length > 0");
    browser.wait("the image has colours", COLOURS);
    browser.wait("the stages are drawn", "document.querySelectorAll('#graph rect').length === 5");
    browser.wait("counters are told", "document.querySelectorAll('#counters .count').length > 5");
    assert_eq!(browser.value("document.querySelector('#space .empty')"), Json::Null, "space is drawn");
    for view in ["eye", "side", "top", "free"] {
        browser.click(&format!("[data-view={view}]"));
    }
    browser.click("[data-frame=world]");
    browser.click("#list tbody tr");
    browser.wait("the track that was clicked is marked", "document.querySelector('#list tbody tr.on') !== null");
    let before = browser.value("Number(document.getElementById('sequence').textContent)").as_u64().unwrap();
    browser.wait("frames follow", &format!("Number(document.getElementById('sequence').textContent) > {}", before + 3));
    assert_eq!(browser.value("document.getElementById('link').textContent"), "live");
    browser.look("live");
}

#[test]
fn a_browser_plays_a_recording_by_its_time_line_also_on_a_phone() {
    let Some(browser) = Browser::start(500, 900) else { return };
    let playground = Playground::new();
    recording(&playground, "60");
    let page = Page::open(&playground, &["run.mcap"]);
    browser.visit(&page);
    browser.wait("the time line is there", "!document.getElementById('timeline').hidden");
    browser.wait("it plays to its end", "document.getElementById('play').getAttribute('aria-label') === 'Play'");
    let shows = |sequence: u64| format!("document.getElementById('sequence').textContent === '{sequence}'");
    browser.wait("the last frame", &shows(59));
    browser.click("#back");
    browser.wait("the frame before", &shows(58));
    browser.click("#forward");
    browser.wait("and the last again", &shows(59));
    browser.value("(() => { const p = document.getElementById('position'); p.value = '0'; p.dispatchEvent(new Event('input')); })()");
    browser.wait("the first", &shows(0));
    browser.wait("the image has colours", COLOURS);
    let is_narrow = "document.documentElement.scrollWidth <= window.innerWidth";
    assert_eq!(browser.value(is_narrow), true, "nothing is wider than the phone");
    browser.look("recording");
}

#[test]
fn a_browser_pauses_a_run_and_steps_it() {
    let Some(browser) = Browser::start(1400, 1000) else { return };
    let playground = Playground::with_pipeline(TRACKING);
    let _run = playground.start(&SLOWLY);
    let page = Page::open(&playground, &[]);
    browser.visit(&page);
    browser.wait(
        "the run can be paused",
        "!document.getElementById('timeline').hidden && !document.getElementById('play').disabled",
    );
    browser.wait("tracks are listed", "document.querySelectorAll('#list tbody .swatch').length > 0");
    browser.click("#play");
    browser.wait("it is paused", "document.getElementById('link').textContent === 'paused'");
    assert_eq!(browser.value("document.getElementById('position').hidden"), true, "a run has no time line");
    let sequence = "Number(document.getElementById('sequence').textContent)";
    let (mut before, mut now) = (Json::Null, browser.value(sequence));
    wait_until("it stands still", || {
        playground.top();
        before = std::mem::replace(&mut now, browser.value(sequence));
        before == now
    });
    let at = now.as_u64().unwrap();
    browser.click("#forward");
    browser.wait("a frame more", &format!("{sequence} > {at}"));
    browser.look("paused");
    browser.click("#play");
    browser.wait("it goes on", &format!("{sequence} > {}", at + 5));
    assert_eq!(browser.value("document.getElementById('link').textContent"), "live");
}

#[test]
fn a_browser_shows_two_variants_one_over_the_other() {
    let playground = Playground::with_pipeline(SIMULATED);
    for (name, width, height) in [("variants", 1400, 1000), ("variants_phone", 500, 900)] {
        let Some(browser) = Browser::start(width, height) else { return };
        if !playground.path("kept").exists() {
            playground.conicflow(&[&["compare", "--record", "kept", "--a"], &PAPER[..]].concat()).expect_code(0);
        }
        let page = Page::open(&playground, &["kept/a.mcap", "kept/b.mcap"]);
        browser.visit(&page);
        browser.wait("both are named", "document.querySelectorAll('#variants .swatch').length === 2");
        browser.wait("it plays to its end", "document.getElementById('play').getAttribute('aria-label') === 'Play'");
        browser.wait("differences are listed", "document.querySelectorAll('#list tbody td[data-label=B]').length > 0");
        browser.wait("the list is counted", "document.getElementById('list-note').textContent.includes('in both')");
        browser.wait("the image has colours", COLOURS);
        let is_narrow = "document.documentElement.scrollWidth <= window.innerWidth";
        assert_eq!(browser.value(is_narrow), true, "nothing is wider than the window");
        browser.look(name);
    }
}
