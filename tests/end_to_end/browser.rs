//! Opens the page in Chromium and in Firefox; a test prints which of the two is missing. `CONICFLOW_PICTURES` names a folder for
//! screenshots.

use crate::compare::{PAPER, simulated};
use crate::support::{Playground, TRACKING, wait_until};
use crate::view::{Page, recording};
use crate::webdriver::{Browser, in_each_browser};
use serde_json::Value as Json;

/// A run without an end, at a rate that a browser without a graphics card can follow.
const PACED: [&str; 3] = ["run", "--set", "source.rate_hz=10"];
/// Number of different colours of an image on the page.
const COLOURS: &str = "(() => { const c = document.getElementById('image'); \
    const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer); \
    return new Set(d).size > 50; })()";

/// Starts each browser once, because that takes longer than most of the checks.
#[test]
fn each_browser_shows_runs_recordings_and_variants() {
    in_each_browser(1000, 700, |browser| {
        it_shows_a_run_in_the_image_in_space_and_as_stages(browser);
        it_plays_a_recording_by_its_time_line_also_on_a_phone(browser);
        it_pauses_a_run_and_steps_it(browser);
        it_shows_two_variants_one_over_the_other(browser);
    });
}

fn it_shows_a_run_in_the_image_in_space_and_as_stages(browser: &Browser) {
    browser.resize(1000, 700);
    let playground = Playground::with_pipeline(TRACKING);
    let run = playground.start(&PACED);
    let page = Page::open(&playground, &[]);
    browser.visit(&page.url());
    browser.wait("tracks are listed", "document.querySelectorAll('#list tbody .swatch').length > 0");
    browser.wait("the image has colours", COLOURS);
    browser.wait("the stages are drawn", "document.querySelectorAll('#graph rect').length === 5");
    browser.wait("counters are told", "document.querySelectorAll('#counters .count').length > 5");
    assert_eq!(browser.value("document.querySelector('#space .empty')"), Json::Null, "space is drawn");
    for view in ["eye", "side", "top", "free"] {
        browser.click(&format!("[data-view={view}]"));
    }
    browser.click("[data-frame=world]");
    // A track may end before the next frame is listed.
    browser.wait(
        "a track that is clicked is marked",
        "(document.querySelector('#list tbody tr').click(), \
         document.querySelector('#list tbody tr.on button[aria-pressed=true]') !== null)",
    );
    let before = browser.value("Number(document.getElementById('sequence').textContent)").as_u64().unwrap();
    browser.wait("frames follow", &format!("Number(document.getElementById('sequence').textContent) > {}", before + 3));
    assert_eq!(browser.value("document.getElementById('link').textContent"), "live");
    browser.expect_no_faults("live");
    drop(run);
    browser.wait("it says that the run is over", "document.getElementById('link').textContent === 'waiting'");
    browser.wait("and how often frames come no more", "document.getElementById('rate').textContent === '–'");
    browser.leave();
}

fn it_plays_a_recording_by_its_time_line_also_on_a_phone(browser: &Browser) {
    browser.resize(500, 900);
    let playground = Playground::new();
    recording(&playground, "30");
    let page = Page::open(&playground, &["run.mcap"]);
    browser.visit(&page.url());
    browser.wait("the time line is there", "!document.getElementById('timeline').hidden");
    browser.wait("it plays to its end", "document.getElementById('play').getAttribute('aria-label') === 'Play'");
    let shows = |sequence: u64| format!("document.getElementById('sequence').textContent === '{sequence}'");
    browser.wait("the last frame", &shows(29));
    browser.click("#back");
    browser.wait("the frame before", &shows(28));
    browser.click("#forward");
    browser.wait("and the last again", &shows(29));
    browser.value(
        "(() => { const p = document.getElementById('position'); p.value = '0'; \
         p.dispatchEvent(new Event('input')); })()",
    );
    browser.wait("the first", &shows(0));
    browser.wait("the image has colours", COLOURS);
    let is_narrow = "document.documentElement.scrollWidth <= window.innerWidth";
    assert_eq!(browser.value(is_narrow), true, "nothing is wider than the phone");
    browser.expect_no_faults("recording");
    browser.leave();
}

fn it_pauses_a_run_and_steps_it(browser: &Browser) {
    browser.resize(1000, 700);
    let playground = Playground::with_pipeline(TRACKING);
    let _run = playground.start(&PACED);
    let page = Page::open(&playground, &[]);
    browser.visit(&page.url());
    browser.wait(
        "the run can be paused",
        "!document.getElementById('timeline').hidden && !document.getElementById('play').disabled",
    );
    browser.wait("tracks are listed", "document.querySelectorAll('#list tbody .swatch').length > 0");
    browser.point_at("#play");
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
    browser.press("ArrowRight");
    browser.wait("one more by its key", &format!("{sequence} > {}", at + 1));
    browser.expect_no_faults("paused");
    browser.press(" ");
    browser.wait("it goes on", &format!("{sequence} > {}", at + 5));
    browser.wait("it says so", "document.getElementById('link').textContent === 'live'");
    browser.leave();
}

fn it_shows_two_variants_one_over_the_other(browser: &Browser) {
    let playground = Playground::with_pipeline(&simulated());
    playground.conicflow(&[&["compare", "--record", "kept", "--a"], &PAPER[..]].concat()).expect_code(0);
    for (name, width, height) in [("variants", 1000, 700), ("variants_phone", 500, 900)] {
        browser.resize(width, height);
        let page = Page::open(&playground, &["kept/a.mcap", "kept/b.mcap"]);
        browser.visit(&page.url());
        browser.wait("both are named", "document.querySelectorAll('#variants .swatch').length === 2");
        browser.wait("it plays to its end", "document.getElementById('play').getAttribute('aria-label') === 'Play'");
        browser.wait("differences are listed", "document.querySelectorAll('#list tbody td[data-label=B]').length > 0");
        browser.wait("the list is counted", "document.getElementById('list-note').textContent.includes('in both')");
        browser.wait("the image has colours", COLOURS);
        let is_narrow = "document.documentElement.scrollWidth <= window.innerWidth";
        assert_eq!(browser.value(is_narrow), true, "nothing is wider than the window");
        browser.expect_no_faults(name);
        browser.leave();
    }
}
