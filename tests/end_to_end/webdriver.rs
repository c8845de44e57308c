//! Remote control of browsers: of Chromium through `chromedriver`, and of Firefox through its own Marionette protocol, which has
//! the same commands. Firefox has no WebGL without a display, so it uses Xvfb.

use crate::support::{Started, signal, wait_until};
use crate::view::exchange;
use rustix::process::Signal;
use serde_json::{Value as Json, json};
use std::cell::RefCell;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{ChildStdout, Command, Stdio};
use std::time::Duration;
use tempfile::TempDir;

/// Arguments of Chromium: it needs no graphics card, and sends no requests of its own to the network.
const CHROMIUM: [&str; 10] = [
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
const FIREFOX: [&str; 3] = ["--marionette", "--remote-allow-system-access", "--no-remote"];
/// Settings of Firefox: it takes a free port for Marionette, and starts no processes for pages that may be opened later.
const FIREFOX_SETTINGS: &str = "user_pref('marionette.port', 0);
user_pref('fission.autostart', false);
user_pref('dom.ipc.processCount', 1);
user_pref('dom.ipc.processPrelaunch.enabled', false);
";
/// Script that returns the errors that the page has written to Firefox's console.
const FAULTS_IN_FIREFOX: &str = "return Services.console.getMessageArray()
    .filter(told => told instanceof Ci.nsIScriptError && told.sourceName.startsWith('http://127.0.0.1')
        && !(told.flags & Ci.nsIScriptError.warningFlag))
    .map(String)";

const WAIT_PERIOD: Duration = Duration::from_millis(180);

type Piped = (Started, BufReader<ChildStdout>);

/// A running browser.
pub struct Browser {
    name: &'static str,
    driver: Driver,
}

enum Driver {
    Chromium {
        port: String,
        session: String,
        _driver: Piped,
    },
    /// The fields are dropped in this order: the browser has to end before its profile and its display are removed.
    Firefox {
        stream: RefCell<BufReader<TcpStream>>,
        browser: Started,
        _profile: TempDir,
        _display: Piped,
    },
}

/// Runs the test in each installed browser, in a window of this size, and prints which browser is missing.
pub fn in_each_browser(width: u32, height: u32, mut test: impl FnMut(&Browser)) {
    for start in [Browser::chromium, Browser::firefox] {
        if let Some(browser) = start(width, height) {
            test(&browser);
        }
    }
}

/// The first of these programs that is installed. If none is installed, prints that the browser is skipped.
fn program(names: &[&'static str]) -> Option<&'static str> {
    let is_there = |name: &&str| {
        let looked = Command::new("sh").args(["-c", "command -v \"$0\"", name]).stdout(Stdio::null()).status();
        looked.is_ok_and(|status| status.success())
    };
    let found = names.iter().copied().find(is_there);
    if found.is_none() {
        eprintln!("SKIPPED: there is no {}; what that browser makes of the page was not shown", names.join(" or "));
    }
    found
}

impl Browser {
    fn chromium(width: u32, height: u32) -> Option<Self> {
        program(&["chromium", "google-chrome"])?;
        let mut command = Command::new(program(&["chromedriver"])?);
        command.args(["--port=0"]);
        let (program, mut output) = Started::piped(command);
        let mut port = String::new();
        while !port.contains("successfully on port ") {
            port.clear();
            assert!(output.read_line(&mut port).unwrap() > 0, "{}", program.stderr());
        }
        let port = port.trim().trim_end_matches('.').rsplit(' ').next().unwrap().to_owned();
        let size = format!("--window-size={width},{height}");
        let arguments: Vec<_> = CHROMIUM.into_iter().chain([size.as_str()]).collect();
        let wanted = json!({ "goog:chromeOptions": { "args": arguments }, "goog:loggingPrefs": { "browser": "ALL" } });
        let session =
            ask_chromedriver(&port, "POST", "/session", &json!({ "capabilities": { "alwaysMatch": wanted } }));
        let session = format!("/session/{}", session["sessionId"].as_str().unwrap());
        let browser = Self { name: "chromium", driver: Driver::Chromium { port, session, _driver: (program, output) } };
        browser.resize(width, height);
        Some(browser)
    }

    fn firefox(width: u32, height: u32) -> Option<Self> {
        let mut command = Command::new(program(&["firefox-esr", "firefox"])?);
        let mut xvfb = Command::new(program(&["Xvfb"])?);
        // The screen is larger than the window, because the window has a frame and does not cover the whole screen.
        let screen = format!("{}x{}x24", width + 100, height + 100);
        xvfb.args(["-displayfd", "1", "-nolisten", "tcp", "-screen", "0", &screen]);
        let (display, mut output) = Started::piped(xvfb);
        let mut number = String::new();
        assert!(output.read_line(&mut number).unwrap() > 0, "{}", display.stderr());
        let profile = TempDir::new().unwrap();
        fs::write(profile.path().join("user.js"), FIREFOX_SETTINGS).unwrap();
        command.args(FIREFOX).arg("--profile").arg(profile.path());
        command.env("DISPLAY", format!(":{}", number.trim())).env("HOME", profile.path());
        let mut browser = Started::new(command);
        let at = profile.path().join("MarionetteActivePort");
        let mut port = 0_u16;
        browser.wait_until("it listens", || {
            port = fs::read_to_string(&at).ok().and_then(|text| text.trim().parse().ok()).unwrap_or(0);
            port != 0
        });
        let mut stream = BufReader::new(TcpStream::connect(("127.0.0.1", port)).unwrap());
        assert_eq!(read_marionette(&mut stream)["marionetteProtocol"], 3);
        let (stream, _display) = (RefCell::new(stream), (display, output));
        let driver = Driver::Firefox { stream, browser, _profile: profile, _display };
        let browser = Self { name: "firefox", driver };
        browser.ask("", "WebDriver:NewSession", &json!({}));
        browser.resize(width, height);
        Some(browser)
    }

    /// Sends a command of WebDriver: its path for `chromedriver`, its name for Marionette.
    fn ask(&self, path: &str, name: &str, body: &Json) -> Json {
        match &self.driver {
            Driver::Chromium { port, session, .. } => ask_chromedriver(port, "POST", &format!("{session}{path}"), body),
            Driver::Firefox { stream, .. } => ask_marionette(&mut stream.borrow_mut(), name, body),
        }
    }

    pub fn resize(&self, width: u32, height: u32) {
        self.ask("/window/rect", "WebDriver:SetWindowRect", &json!({ "width": width, "height": height }));
    }

    pub fn visit(&self, url: &str) {
        self.ask("/url", "WebDriver:Navigate", &json!({ "url": url }));
    }

    /// Leaves the page, so that it sends no further requests and reports no missing answers.
    pub fn leave(&self) {
        self.visit("about:blank");
    }

    /// The value of an expression in the page.
    pub fn value(&self, expression: &str) -> Json {
        let script = json!({ "script": format!("return {expression}"), "args": [] });
        self.ask("/execute/sync", "WebDriver:ExecuteScript", &script)
    }

    /// Waits until a condition holds in the page. Checks it only five times a second, because each check takes time that the
    /// browser needs to draw.
    pub fn wait(&self, what: &str, condition: &str) {
        let holds = || {
            let holds = self.value(condition) == true;
            if !holds {
                std::thread::sleep(WAIT_PERIOD);
            }
            holds
        };
        wait_until(&format!("in {}: {what}", self.name), holds);
    }

    pub fn click(&self, selector: &str) {
        self.value(&format!("document.querySelector('{selector}').click()"));
    }

    /// Clicks as a pointer does: the element gets the keyboard's focus first.
    pub fn point_at(&self, selector: &str) {
        let click = "part.dispatchEvent(new MouseEvent('click', { bubbles: true, detail: 1 }))";
        self.value(&format!("(part => (part.focus(), {click}))(document.querySelector('{selector}'))"));
    }

    /// Presses a key in the focused element.
    pub fn press(&self, key: &str) {
        let event = format!("new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }})");
        self.value(&format!("document.activeElement.dispatchEvent({event})"));
    }

    /// The errors that the page has reported.
    fn faults(&self) -> Vec<Json> {
        match &self.driver {
            Driver::Chromium { .. } => {
                let log = self.ask("/se/log", "", &json!({ "type": "browser" }));
                log.as_array().unwrap().iter().filter(|entry| entry["level"] == "SEVERE").cloned().collect()
            }
            Driver::Firefox { .. } => {
                let context = |name: &str| self.ask("", "Marionette:SetContext", &json!({ "value": name }));
                context("chrome");
                let script = json!({ "script": FAULTS_IN_FIREFOX, "args": [], "sandbox": "system" });
                let faults = self.ask("", "WebDriver:ExecuteScript", &script);
                context("content");
                faults.as_array().unwrap().clone()
            }
        }
    }

    /// Asserts that the page has reported no error, and keeps a screenshot if `CONICFLOW_PICTURES` names a folder.
    pub fn expect_no_faults(&self, name: &str) {
        let faults = self.faults();
        assert!(faults.is_empty(), "{}: {faults:?}", self.name);
        let picture = match &self.driver {
            Driver::Chromium { port, session, .. } => {
                ask_chromedriver(port, "GET", &format!("{session}/screenshot"), &Json::Null)
            }
            Driver::Firefox { .. } => self.ask("", "WebDriver:TakeScreenshot", &json!({ "full": false })),
        };
        if let Ok(folder) = std::env::var("CONICFLOW_PICTURES") {
            let file = fs::File::create(format!("{folder}/{name}_{}.png", self.name)).unwrap();
            let mut decoder = Command::new("base64").arg("-d").stdin(Stdio::piped()).stdout(file).spawn().unwrap();
            decoder.stdin.take().unwrap().write_all(picture.as_str().unwrap().as_bytes()).unwrap();
            decoder.wait().unwrap();
        }
    }
}

impl Drop for Browser {
    /// Ends the browser, also after a test that failed. Firefox is killed, as it has nothing to save.
    fn drop(&mut self) {
        match &self.driver {
            Driver::Chromium { port, session, .. } => {
                if let Ok(mut stream) = TcpStream::connect(format!("127.0.0.1:{port}")) {
                    write!(stream, "DELETE {session} HTTP/1.1\r\nHost: localhost\r\n\r\n").ok();
                    // The driver answers when the browser has ended.
                    stream.read_exact(&mut [0]).ok();
                }
            }
            Driver::Firefox { browser, .. } => signal(browser.id(), Signal::KILL),
        }
    }
}

fn ask_chromedriver(port: &str, method: &str, path: &str, body: &Json) -> Json {
    let body = if method == "POST" { body.to_string() } else { String::new() };
    let head = format!("{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json");
    let request = format!("{head}\r\nContent-Length: {}\r\n\r\n{body}", body.len());
    let answer = exchange(&format!("127.0.0.1:{port}"), &request);
    let answer: Json = serde_json::from_slice(&answer.body).unwrap_or_else(|_| panic!("{}", answer.text()));
    assert!(answer["value"]["error"].is_null(), "{path}: {}", answer["value"]);
    answer["value"].clone()
}

/// A message of Marionette is its length, a colon, and JSON: a command is `[0, id, name, arguments]`, an answer `[1, id, error,
/// value]`.
fn ask_marionette(stream: &mut BufReader<TcpStream>, name: &str, body: &Json) -> Json {
    let command = json!([0, 0, name, body]).to_string();
    write!(stream.get_mut(), "{}:{command}", command.len()).unwrap();
    let answer = read_marionette(stream);
    assert!(answer[2].is_null(), "{name}: {}", answer[2]);
    answer[3].get("value").unwrap_or(&answer[3]).clone()
}

fn read_marionette(stream: &mut BufReader<TcpStream>) -> Json {
    let mut length = Vec::new();
    stream.read_until(b':', &mut length).unwrap();
    let length = String::from_utf8(length).unwrap();
    let mut body = vec![0; length.trim_end_matches(':').parse().unwrap()];
    stream.read_exact(&mut body).unwrap();
    serde_json::from_slice(&body).unwrap()
}
