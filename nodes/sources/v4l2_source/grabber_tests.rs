//! Tests of the grabber with a scripted stand-in for the kernel.

use super::*;
use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::rc::Rc;

const NO_SUCH_DEVICE: i32 = 19;

/// The event that a read from the device meets.
#[derive(Clone)]
enum Event {
    /// An image whose pixels all have this value.
    Image(u16),
    /// An incomplete image.
    Bytes(Vec<u8>),
    Damaged(u16),
    Silence,
    Unplugged,
}

/// The outcome of an attempt to find and open the device.
#[derive(Clone)]
enum Attempt {
    Nothing,
    Busy,
    /// The device is there with these modes, and these events follow.
    Device(Vec<Mode>, Vec<Event>),
}

#[derive(Clone, Default)]
struct Script {
    attempts: Rc<RefCell<VecDeque<Attempt>>>,
    opened_modes: Rc<RefCell<Vec<Mode>>>,
    /// Requested when the script is at its end.
    stop: Stop,
}

struct Played {
    layout: Layout,
    events: VecDeque<Event>,
    script: Script,
}

impl Driver for Script {
    type Stream = Played;

    fn devices(&self) -> Vec<Found> {
        let attempts = self.attempts.borrow();
        let modes = match attempts.front() {
            None => {
                self.stop.request();
                return Vec::new();
            }
            Some(Attempt::Nothing) => {
                drop(attempts);
                self.attempts.borrow_mut().pop_front();
                return Vec::new();
            }
            Some(Attempt::Busy) => vec![mode(DepthFormat::Z16, 3, 2)],
            Some(Attempt::Device(modes, _)) => modes.clone(),
        };
        vec![Found { path: "/dev/video2".into(), name: "Depth Camera 435".to_owned(), modes }]
    }

    fn open(&self, _: &Path, mode: &Mode) -> io::Result<(Layout, Played)> {
        self.opened_modes.borrow_mut().push(mode.clone());
        let Some(Attempt::Device(modes, events)) = self.attempts.borrow_mut().pop_front() else {
            return Err(io::Error::from(io::ErrorKind::ResourceBusy));
        };
        // The driver uses its first mode, whatever was requested.
        let Mode { format, width, height, .. } = modes[0];
        let layout = Layout { format, width, height, bytes_per_line: width * 2 + 2 };
        Ok((layout, Played { layout, events: events.into(), script: self.clone() }))
    }
}

impl Stream for Played {
    fn next(&mut self, _: Duration, show: &mut dyn FnMut(&[u8], bool)) -> io::Result<bool> {
        let Layout { height, bytes_per_line, .. } = self.layout;
        let image = |depth: u16| depth.to_le_bytes().repeat((height * bytes_per_line / 2) as usize);
        match self.events.pop_front() {
            Some(Event::Image(depth)) => show(&image(depth), false),
            Some(Event::Damaged(depth)) => show(&image(depth), true),
            Some(Event::Bytes(bytes)) => show(&bytes, false),
            Some(Event::Silence) => {
                std::thread::sleep(Duration::from_millis(2));
                return Ok(false);
            }
            None if self.script.attempts.borrow().is_empty() => {
                self.script.stop.request();
                return Ok(false);
            }
            Some(Event::Unplugged) | None => return Err(io::Error::from_raw_os_error(NO_SUCH_DEVICE)),
        }
        Ok(true)
    }
}

fn mode(format: DepthFormat, width: u32, height: u32) -> Mode {
    Mode { format, width, height, rates_hz: vec![30.0, 60.0] }
}

fn z16(width: u32, height: u32) -> Vec<Mode> {
    vec![mode(DepthFormat::Z16, width, height)]
}

#[derive(Default)]
struct Images {
    image: Vec<u16>,
    counted: BTreeMap<&'static str, u64>,
}

impl ImageOutput for Images {
    fn loan(&mut self, pixels: usize) -> Result<&mut [u16], StageError> {
        self.image = vec![9999; pixels];
        Ok(&mut self.image)
    }

    fn count(&mut self, name: &'static str) {
        *self.counted.entry(name).or_default() += 1;
    }
}

/// The results of a run with a script.
struct Outcome {
    /// Number of pixels and the value of all of them.
    images: Vec<(usize, u16)>,
    counted: BTreeMap<&'static str, u64>,
    opened_modes: Vec<Mode>,
    /// The last warning, without its numbers.
    last_warning: Option<String>,
    refused: Option<String>,
}

fn play(wanted: Wanted, attempts: Vec<Attempt>) -> Outcome {
    let script = Script { attempts: Rc::new(RefCell::new(attempts.into())), ..Script::default() };
    let mut grabber = Grabber::new(script.clone(), wanted, script.stop.clone());
    grabber.try_again = Duration::from_millis(1);
    let (mut output, mut images, mut refused) = (Images::default(), Vec::new(), None);
    loop {
        match grabber.next(&mut output) {
            Ok(Some(layout)) => {
                assert_eq!(layout.pixels(), output.image.len());
                assert!(output.image.iter().all(|pixel| *pixel == output.image[0]), "{:?}", output.image);
                images.push((output.image.len(), output.image[0]));
            }
            Ok(None) => break,
            Err(error) => {
                refused = Some(error.to_string());
                break;
            }
        }
    }
    let opened_modes = script.opened_modes.borrow().clone();
    Outcome { images, counted: output.counted, opened_modes, last_warning: grabber.last_warning, refused }
}

fn patient() -> Wanted {
    Wanted { stall: Duration::from_secs(3600), ..Wanted::default() }
}

fn device(events: &[Event]) -> Attempt {
    Attempt::Device(z16(3, 2), events.to_vec())
}

#[test]
fn images_are_delivered_without_the_gaps_between_their_rows() {
    let outcome = play(patient(), vec![device(&[Event::Image(1), Event::Silence, Event::Image(2)])]);
    assert_eq!(outcome.images, [(6, 1), (6, 2)]);
    assert!(outcome.counted.is_empty() && outcome.last_warning.is_none() && outcome.refused.is_none());
}

#[test]
fn a_missing_or_busy_camera_is_waited_for() {
    let nothing = || Attempt::Nothing;
    let outcome = play(patient(), vec![nothing(), nothing(), Attempt::Busy, device(&[Event::Image(1)])]);
    assert_eq!(outcome.images, [(6, 1)]);
    assert!(outcome.counted.is_empty(), "the first time is no return");
}

#[test]
fn a_camera_that_is_unplugged_is_reopened_also_with_another_size() {
    let larger = Attempt::Device(z16(5, 4), vec![Event::Image(2)]);
    let first = device(&[Event::Image(1), Event::Unplugged]);
    let outcome = play(patient(), vec![first, Attempt::Nothing, Attempt::Nothing, larger]);
    assert_eq!(outcome.images, [(6, 1), (20, 2)]);
    assert_eq!(outcome.counted, BTreeMap::from([(OPENED, 1)]));
}

#[test]
fn a_camera_that_stalls_is_reopened() {
    let wanted = Wanted { stall: Duration::from_millis(20), ..Wanted::default() };
    let mut silent = vec![Event::Image(1)];
    silent.extend(vec![Event::Silence; 1000]);
    let outcome = play(wanted, vec![device(&silent), device(&[Event::Image(2)])]);
    assert_eq!(outcome.images, [(6, 1), (6, 2)]);
    assert_eq!(outcome.counted, BTreeMap::from([(OPENED, 1)]));
}

#[test]
fn a_slow_pipeline_is_not_taken_for_a_stalled_camera() {
    let script = Script::default();
    script.attempts.borrow_mut().push_back(device(&[Event::Image(1), Event::Silence, Event::Image(2)]));
    let wanted = Wanted { stall: Duration::from_secs(60), ..Wanted::default() };
    let mut grabber = Grabber::new(script.clone(), wanted, script.stop.clone());
    let mut output = Images::default();
    grabber.next(&mut output).unwrap().unwrap();
    grabber.last_image_at -= Duration::from_secs(3600);
    grabber.next(&mut output).unwrap().unwrap();
    assert_eq!(output.image[0], 2);
    assert!(output.counted.is_empty());
}

#[test]
fn incomplete_images_are_counted_and_skipped() {
    let events = [
        Event::Image(1),
        Event::Bytes(Vec::new()),
        Event::Bytes(vec![7; 13]),
        Event::Damaged(5),
        Event::Image(2),
        Event::Damaged(5),
    ];
    let outcome = play(patient(), vec![device(&events)]);
    assert_eq!(outcome.images, [(6, 1), (6, 2)]);
    assert_eq!(outcome.counted, BTreeMap::from([(UNREADABLE, 4)]));
    assert!(outcome.last_warning.unwrap().contains("Depth Camera  sends an image that its driver calls damaged"));
}

#[test]
fn the_best_format_with_depths_is_chosen() {
    let modes = vec![
        mode(DepthFormat::Y16, 8, 8),
        mode(DepthFormat::Inzi, 3, 2),
        mode(DepthFormat::Z16, 3, 2),
        mode(DepthFormat::Z16, 5, 4),
    ];
    let chosen = |wanted: Wanted| {
        let outcome = play(wanted, vec![Attempt::Device(modes.clone(), vec![])]);
        outcome.opened_modes.first().map(|mode| (mode.format, mode.width, mode.rates_hz.clone())).ok_or(outcome.refused)
    };
    assert_eq!(chosen(patient()), Ok((DepthFormat::Z16, 3, vec![])));
    assert_eq!(chosen(Wanted { size: Some((5, 4)), ..patient() }), Ok((DepthFormat::Z16, 5, vec![])));
    assert_eq!(chosen(Wanted { format: Some(DepthFormat::Y16), ..patient() }), Ok((DepthFormat::Y16, 8, vec![])));
    assert_eq!(chosen(Wanted { fps: Some(60.0), ..patient() }), Ok((DepthFormat::Z16, 3, vec![60.0])));
    let error = chosen(Wanted { size: Some((640, 480)), fps: Some(90.0), ..patient() }).unwrap_err().unwrap();
    assert!(error.starts_with("`/dev/video2` (Depth Camera 435) has no depth images of 640x480 at 90 Hz\n"), "{error}");
    assert!(error.contains("hint: it has y16 8x8 at 30, 60 Hz; inzi 3x2 at 30, 60 Hz; z16 3x2"), "{error}");
}

#[test]
fn grey_is_taken_for_depth_only_if_the_file_says_so() {
    let grey = || vec![Attempt::Device(vec![mode(DepthFormat::Y16, 3, 2)], vec![Event::Image(1)]), Attempt::Nothing];
    let outcome = play(Wanted { device: Some("depth camera".to_owned()), ..patient() }, grey());
    assert!(outcome.refused.unwrap().ends_with("; `format = \"y16\"` takes grey for depth"));
    assert!(play(Wanted { format: Some(DepthFormat::Y16), ..patient() }, grey()[..1].to_vec()).images == [(6, 1)]);
}

#[test]
fn a_device_that_sends_another_format_is_refused_at_the_start_and_waited_for_later() {
    let offered = || vec![mode(DepthFormat::Inzi, 3, 2), mode(DepthFormat::Z16, 3, 2)];
    let wrong = || Attempt::Device(offered(), vec![Event::Image(1)]);
    let wanted = || Wanted { format: Some(DepthFormat::Z16), ..patient() };
    let refused = play(wanted(), vec![wrong()]).refused.unwrap();
    assert!(refused.contains("sends inzi 3x2 in place of z16 3x2"), "{refused}");
    let first = device(&[Event::Image(1), Event::Unplugged]);
    let outcome = play(wanted(), vec![first, wrong(), device(&[Event::Image(2)])]);
    assert_eq!(outcome.images, [(6, 1), (6, 2)]);
}

#[test]
fn a_camera_is_named_by_its_path_or_a_part_of_its_name() {
    let found = Found { path: "/dev/video2".into(), name: "Depth Camera 435".to_owned(), modes: z16(3, 2) };
    for name in ["/dev/video2", "435", "depth camera"] {
        assert!(is_named(&found, name), "{name}");
    }
    for name in ["/dev/video21", "/dev/video", "video2", "Astra"] {
        assert!(!is_named(&found, name), "{name}");
    }
    let folder = tempfile::tempdir().unwrap();
    let (file, link) = (folder.path().join("video2"), folder.path().join("by-id"));
    std::fs::write(&file, "").unwrap();
    std::os::unix::fs::symlink(&file, &link).unwrap();
    let linked = Found { path: file.canonicalize().unwrap(), ..found.clone() };
    assert!(is_named(&linked, link.to_str().unwrap()));
    assert_eq!(found.to_string(), "`/dev/video2` (Depth Camera 435): z16 3x2 at 30, 60 Hz");
}
