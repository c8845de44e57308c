//! Support for the end-to-end tests: a playground for each test, runs that end with their test, and waits for conditions in place
//! of fixed times.

use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::Camera;
use rustix::fs::{Mode, OFlags};
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::{Value as Json, json};
use std::fs::{self, File, Permissions};
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Maximum wait for a condition. Every condition that a test waits for holds long before this, so a test that waits longer has
/// failed.
pub const DEADLINE: Duration = Duration::from_secs(120);
pub const CHECK_PERIOD: Duration = Duration::from_millis(20);
/// Number of runs that a test tries if a busy machine may restart a stage that has to send heartbeats often. One of the runs has
/// to end without a restart.
pub const TRIES: usize = 5;

/// Five stages that find and track a ball in small images, without losing a frame, until the run is stopped.
pub const TRACKING: &str = r#"
name = "tracking"

[stage.source]
node       = "synthetic_source"
output     = "depth"
width      = 64
height     = 48
rate_hz    = 0
intrinsics = { fx = 200, fy = 200, cx = 31.5, cy = 23.5 }

[stage.extractor]
node   = "row_ellipse_extractor"
input  = { topic = "depth", delivery = "lossless" }
output = "ellipses"

[stage.assembler]
node   = "object_assembler"
input  = { topic = "ellipses", delivery = "lossless" }
output = "objects"

[stage.tracker]
node   = "kalman_tracker"
input  = { topic = "objects", delivery = "lossless" }
output = "tracks"

[stage.json]
node  = "json_sink"
input = { topic = "tracks", delivery = "lossless" }
path  = "tracks.jsonl"
"#;

/// Three stages with little work for each frame: a source, a stage between, and a sink.
pub const FINDING: &str = r#"
name = "tracking"

[stage.source]
node       = "synthetic_source"
output     = "depth"
width      = 16
height     = 12
rate_hz    = 0
intrinsics = { fx = 50, fy = 50, cx = 7.5, cy = 5.5 }

[stage.extractor]
node   = "row_ellipse_extractor"
input  = { topic = "depth", delivery = "lossless" }
output = "ellipses"

[stage.json]
node  = "json_sink"
input = { topic = "ellipses", delivery = "lossless" }
path  = "tracks.jsonl"
"#;

/// Names of the stages of [`FINDING`].
pub const FINDING_STAGES: [&str; 3] = ["source", "extractor", "json"];

/// The stages of [`TRACKING`] after another source. With `lossless` they process each message, with `latest` the newest one.
pub fn tracking_behind(source: &str, delivery: &str) -> String {
    let (_, stages) = TRACKING.split_once("[stage.extractor]").unwrap();
    let stages = stages.replace("lossless", delivery);
    format!("name = \"tracking\"\n[stage.source]\noutput = \"depth\"\n{source}\n[stage.extractor]{stages}")
}

/// Names of the stages of [`TRACKING`].
pub const TRACKING_STAGES: [&str; 5] = ["source", "extractor", "assembler", "tracker", "json"];

/// Topics of [`TRACKING`], each with its writer and its reader.
pub const TRACKING_TOPICS: [(&str, &str, &str); 4] = [
    ("depth", "source", "extractor"),
    ("ellipses", "extractor", "assembler"),
    ("objects", "assembler", "tracker"),
    ("tracks", "tracker", "json"),
];

/// Three stages that find the objects in the recorded frames of the folder `frames`, and end with the last frame.
pub const RECORDING: &str = r#"
name = "recording"

[stage.source]
node    = "image_source"
output  = "depth"
path    = "frames/"
rate_hz = 0
noise   = "ideal"

[stage.extractor]
node   = "row_ellipse_extractor"
input  = { topic = "depth", delivery = "lossless" }
output = "ellipses"

[stage.assembler]
node   = "object_assembler"
input  = { topic = "ellipses", delivery = "lossless" }
output = "objects"

[stage.json]
node  = "json_sink"
input = { topic = "objects", delivery = "lossless" }
path  = "objects.jsonl"
"#;

/// A folder for the files of a test, and a folder with a short path for the runtime files of its runs. A test touches no other
/// files.
pub struct Playground {
    files: TempDir,
    runtime: TempDir,
}

impl Playground {
    /// Creates a playground whose runtime files lie in memory where possible, as those of a user do. A file system on a disk
    /// creates small files slowly if many were deleted shortly before.
    pub fn new() -> Self {
        Self::with_runs_in(["/dev/shm", "/tmp"].into_iter().find(|folder| Path::new(folder).is_dir()).unwrap())
    }

    /// Creates a playground whose files all lie in memory where possible: a disk is slow with very many files.
    pub fn in_memory() -> Self {
        let mut playground = Self::new();
        playground.files = TempDir::new_in(playground.runtime().parent().unwrap()).unwrap();
        playground
    }

    /// Creates a playground whose runtime files lie in /tmp, for runs that have another /dev/shm than the test.
    pub fn outside_shared_memory() -> Self {
        Self::with_runs_in("/tmp")
    }

    /// Creates a playground whose runtime folder lies in this folder. The path has to be short, because the runtime folder
    /// contains Unix sockets.
    fn with_runs_in(folder: &str) -> Self {
        let private = Permissions::from_mode(0o700);
        let runtime = tempfile::Builder::new().prefix("cf").permissions(private).tempdir_in(folder).unwrap();
        Self { files: TempDir::new().unwrap(), runtime }
    }

    /// Creates a playground with this text in `pipeline.toml`, which each command reads by default.
    pub fn with_pipeline(text: &str) -> Self {
        Self::new().and_pipeline(text)
    }

    /// Writes this text to `pipeline.toml` of the playground.
    pub fn and_pipeline(self, text: &str) -> Self {
        self.write("pipeline.toml", text);
        self
    }

    /// Path of a file or folder of the test.
    pub fn path(&self, name: &str) -> PathBuf {
        self.files.path().join(name)
    }

    /// The folder of the runtime files.
    pub fn runtime(&self) -> &Path {
        self.runtime.path()
    }

    /// Ids of all processes of runs in this playground, also of processes whose parent has died.
    pub fn processes(&self) -> Vec<u32> {
        let runtime = self.runtime.path().to_str();
        let own = |process: &u32| environment(*process, "CONICFLOW_RUNTIME_DIR").as_deref() == runtime;
        processes().filter(own).filter(|process| parent(*process).is_some()).collect()
    }

    pub fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    /// Writes depth images of a scene, seen by a camera of 320x240 pixels, in millimetres: `frames/0.png` and so on.
    pub fn record(&self, scene: Scene, seed: u64, frames: u64) -> Camera {
        let config = SimulatorParameters { width: 320, height: 240, ..SimulatorParameters::default() };
        let camera = config.camera();
        let mut synthetic = SyntheticCamera::new(scene, camera, config.noise, 0.001, 30.0, seed);
        fs::create_dir(self.path("frames")).unwrap();
        for number in 0..frames {
            self.write_depth_png(&format!("frames/{number}.png"), 320, &synthetic.frame(number).1);
        }
        camera
    }

    /// Like [`Self::record`], and also writes the camera to `frames/camera.json`.
    pub fn record_with_camera(&self, scene: Scene, seed: u64, frames: u64) -> Camera {
        let camera = self.record(scene, seed, frames);
        let Camera { width, height, fx, fy, cx, cy } = camera;
        let json = json!({ "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy });
        self.write("frames/camera.json", &json.to_string());
        camera
    }

    /// Writes a depth image as a PNG of 16 bits.
    pub fn write_depth_png(&self, name: &str, width: u32, pixels: &[u16]) {
        depth_png(BufWriter::new(File::create(self.path(name)).unwrap()), width, pixels);
    }

    /// The complete lines of a file; none if the file does not exist.
    pub fn lines(&self, name: &str) -> Vec<String> {
        let text = fs::read_to_string(self.path(name)).unwrap_or_default();
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        whole.lines().map(str::to_owned).collect()
    }

    /// Number of complete lines of a file. This is faster than to copy the lines.
    pub fn count(&self, name: &str) -> usize {
        fs::read_to_string(self.path(name)).unwrap_or_default().matches('\n').count()
    }

    /// The complete lines of a file of JSON objects.
    pub fn json_lines(&self, name: &str) -> Vec<Json> {
        self.lines(name).iter().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// The sequence numbers in a file of JSON objects.
    pub fn sequences(&self, name: &str) -> Vec<u64> {
        self.sequences_from(name, 0)
    }

    /// The sequence numbers in a file of JSON objects from line `first` on, for tests that read the file again after each of many
    /// steps.
    pub fn sequences_from(&self, name: &str, first: usize) -> Vec<u64> {
        let lines = self.lines(name);
        let numbers =
            lines[first..].iter().map(|line| serde_json::from_str::<Json>(line).unwrap()["sequence"].as_u64());
        numbers.map(Option::unwrap).collect()
    }

    /// The sequence number in the last complete line of a file of JSON objects; 0 without such a line. Reads only the end of the
    /// file, because tests call this function repeatedly, and it takes processor time from the stages.
    pub fn newest(&self, name: &str) -> u64 {
        const LENGTH: u64 = 512 * 1024;
        let Ok(mut file) = File::open(self.path(name)) else { return 0 };
        let start = file.metadata().unwrap().len().saturating_sub(LENGTH);
        file.seek(SeekFrom::Start(start)).unwrap();
        let mut text = String::new();
        file.read_to_string(&mut text).unwrap();
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let last = whole.lines().next_back();
        last.map_or(0, |line| serde_json::from_str::<Json>(line).unwrap()["sequence"].as_u64().unwrap())
    }

    /// Asserts that `tracks.jsonl` has each frame of the source of a run exactly once, in order. Returns the number of frames.
    pub fn expect_each_frame(&self, ended: &Ended) -> u64 {
        let (made, sequences) = (ended.stage("source").messages, self.sequences("tracks.jsonl"));
        assert!(sequences.iter().copied().eq(0..made), "not each of {made}: {sequences:?}: {}", ended.stderr);
        made
    }

    /// Output of `top --once` for the only pipeline.
    pub fn top(&self) -> Json {
        let ended = self.conicflow(&["top", "--once"]).expect_code(0);
        let state: Json = serde_json::from_str(&ended.stdout).unwrap();
        state["pipelines"][0].clone()
    }

    /// Output of `top --once` for a stage.
    pub fn top_stage(&self, name: &str) -> Json {
        let top = self.top();
        let mut stages = top["stages"].as_array().into_iter().flatten();
        stages.find(|stage| stage["stage"] == name).cloned().unwrap_or_default()
    }

    /// `conicflow` with these arguments, in the folder of the test's files.
    pub fn command(&self, arguments: &[&str]) -> Command {
        self.command_of(Path::new(env!("CARGO_BIN_EXE_conicflow")), arguments)
    }

    /// Another program with these arguments, in the folder of the test's files.
    pub fn command_of(&self, program: &Path, arguments: &[&str]) -> Command {
        let mut command = Command::new(program);
        let inherited = std::env::vars_os().map(|(name, _)| name);
        inherited.filter(|name| name.to_string_lossy().starts_with("CONICFLOW_")).for_each(|name| {
            command.env_remove(name);
        });
        command.args(arguments).current_dir(self.files.path()).env("CONICFLOW_RUNTIME_DIR", self.runtime.path());
        // The machines of a test share the key of their user, which is kept in this folder.
        command.env("XDG_STATE_HOME", env!("CARGO_TARGET_TMPDIR"));
        command.stdin(Stdio::null());
        command
    }

    /// Starts `conicflow` with these arguments.
    pub fn start(&self, arguments: &[&str]) -> Started {
        Started::new(self.command(arguments))
    }

    /// Runs `conicflow` with these arguments to its end.
    pub fn conicflow(&self, arguments: &[&str]) -> Ended {
        self.start(arguments).wait()
    }
}

impl Drop for Playground {
    /// Ends the processes that a failed test has left running, and removes the shared memory that killed processes have left.
    /// This happens before the runtime folder is removed, because `doctor` finds the shared memory by this folder.
    fn drop(&mut self) {
        let since = Instant::now();
        while !self.processes().is_empty() && since.elapsed() < DEADLINE {
            self.processes().into_iter().for_each(|process| signal(process, Signal::KILL));
            std::thread::sleep(CHECK_PERIOD);
        }
        if self.runtime().join("shm").is_dir() {
            // The command runs in the runtime folder, because in the folder of the test's files `doctor` would also check the
            // pipeline file.
            self.command(&["doctor", "--clean"]).current_dir(self.runtime()).output().ok();
        }
    }
}

/// Writes a depth image as a PNG of 16 bits.
pub fn depth_png(output: impl Write, width: u32, pixels: &[u16]) {
    let mut encoder = png::Encoder::new(output, width, pixels.len() as u32 / width);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let bytes: Vec<u8> = pixels.iter().flat_map(|pixel| pixel.to_be_bytes()).collect();
    encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
}

/// Returns the format of a PNG and the bytes of its pixels.
pub fn read_png(path: &Path) -> (png::OutputInfo, Vec<u8>) {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    (info, bytes)
}

/// Copies a program with `cp`. If the test process itself had the copy open for writing, a process that another test forks at
/// that moment would inherit the open file, and the copy could not be executed.
pub fn copy_program(from: &Path, to: &Path) {
    assert!(Command::new("cp").args([from, to]).status().unwrap().success());
}

/// Ids of all processes; none where there is no /proc.
pub fn processes() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

/// Parent of a process; `None` if the process does not run.
pub fn parent(process: u32) -> Option<u32> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    let mut after_name = stat.rsplit_once(')')?.1.split_whitespace();
    let state = after_name.next()?;
    // As long as one of its threads is left, a process keeps its files and locks, also if its first thread has ended.
    let threads = || fs::read_dir(format!("/proc/{process}/task")).map_or(0, Iterator::count);
    after_name.next()?.parse().ok().filter(|_| state != "Z" || threads() > 1)
}

/// Value of a variable in the environment with which a process was started.
pub fn environment(process: u32, name: &str) -> Option<String> {
    let bytes = fs::read(format!("/proc/{process}/environ")).ok()?;
    let text = String::from_utf8_lossy(&bytes).into_owned();
    text.split('\0').find_map(|entry| entry.strip_prefix(name)?.strip_prefix('=')).map(str::to_owned)
}

/// Sends a signal to a process, which may have ended.
pub fn signal(process: u32, signal: Signal) {
    Pid::from_raw(process.cast_signed()).map(|process| kill_process(process, signal));
}

/// Appends another command with its arguments to the arguments of `outer`, and takes over its folder and its environment.
pub fn within(mut outer: Command, inner: &Command) -> Command {
    outer.arg(inner.get_program()).args(inner.get_args()).stdin(Stdio::null());
    if let Some(folder) = inner.get_current_dir() {
        outer.current_dir(folder);
    }
    for (name, value) in inner.get_envs() {
        match value {
            Some(value) => outer.env(name, value),
            None => outer.env_remove(name),
        };
    }
    outer
}

/// A command that runs `inner` with the default action for SIGHUP, also if `nohup` runs the tests.
pub fn hearing_hangups(inner: &Command) -> Command {
    let mut env = Command::new("env");
    env.arg("--default-signal=HUP");
    within(env, inner)
}

/// Opens a terminal. Returns the end of the user and the end of the program.
pub fn terminal() -> (File, OwnedFd) {
    let outer = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&outer).unwrap();
    unlockpt(&outer).unwrap();
    let path = ptsname(&outer, Vec::new()).unwrap();
    let inner = rustix::fs::open(path, OFlags::RDWR | OFlags::NOCTTY, Mode::empty()).unwrap();
    (outer.into(), inner)
}

/// Path of a program of `examples/`, which is built together with the program under test.
pub fn example(name: &str) -> String {
    let path = Path::new(env!("CARGO_BIN_EXE_conicflow")).with_file_name("examples").join(name);
    assert!(path.is_file(), "there is no `{}`; `cargo test` and `cargo build --examples` make it", path.display());
    path.to_str().unwrap().to_owned()
}

/// The Python of the tests if it can import these modules. Otherwise prints that the test is skipped, and what the Python
/// `lacks`.
pub fn python_with(modules: &str, lacks: &str) -> Option<String> {
    let python = std::env::var("CONICFLOW_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let imported = Command::new(&python).args(["-c", &format!("import {modules}")]).stderr(Stdio::null()).status();
    if imported.is_ok_and(|status| status.success()) {
        return Some(python);
    }
    eprintln!("SKIPPED: `{python}` {lacks}");
    None
}

/// A running program. It is killed together with its stages when the test ends, also if the test fails.
pub struct Started {
    child: Child,
    /// Files with the standard output and the standard error of the program.
    texts: TempDir,
}

/// Result of a program that has ended.
#[derive(Debug)]
pub struct Ended {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Started {
    pub fn new(mut command: Command) -> Self {
        let texts = TempDir::new().unwrap();
        let text = |name: &str| File::create(texts.path().join(name)).unwrap();
        Self { child: command.stdout(text("stdout")).stderr(text("stderr")).spawn().unwrap(), texts }
    }

    /// Starts a program whose standard output the test reads line by line.
    pub fn piped(mut command: Command) -> (Self, BufReader<ChildStdout>) {
        let texts = TempDir::new().unwrap();
        let stderr = File::create(texts.path().join("stderr")).unwrap();
        File::create(texts.path().join("stdout")).unwrap();
        let mut child = command.stdout(Stdio::piped()).stderr(stderr).spawn().unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        (Self { child, texts }, output)
    }

    /// Starts a program whose standard output goes to the place that the command sets.
    pub fn watched(mut command: Command) -> Self {
        let texts = TempDir::new().unwrap();
        ["stdout", "stderr"].into_iter().for_each(|name| drop(File::create(texts.path().join(name)).unwrap()));
        Self { child: command.spawn().unwrap(), texts }
    }

    /// Id of the process of the program.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Whether the program runs.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Standard error of the program so far.
    pub fn stderr(&self) -> String {
        self.text("stderr")
    }

    fn text(&self, name: &str) -> String {
        fs::read_to_string(self.texts.path().join(name)).unwrap()
    }

    /// Waits until a condition holds. Panics if the program ends before.
    pub fn wait_until(&mut self, what: &str, mut holds: impl FnMut() -> bool) {
        let since = Instant::now();
        while !holds() {
            assert!(self.child.try_wait().unwrap().is_none(), "it ended before {what}: {}", self.stderr());
            assert!(since.elapsed() < DEADLINE, "never came true: {what}: {}", self.stderr());
            std::thread::sleep(CHECK_PERIOD);
        }
    }

    /// Waits until the standard error of the program contains this text.
    pub fn wait_for_text(&mut self, text: &str) {
        let path = self.texts.path().join("stderr");
        self.wait_until(text, || fs::read_to_string(&path).unwrap().contains(text));
    }

    /// Interrupts the program, as Ctrl-C does, and asserts that it ends with exit code 0.
    pub fn end(self) -> Ended {
        signal(self.id(), Signal::INT);
        self.wait().expect_code(0)
    }

    /// Waits until the program ends.
    pub fn wait(mut self) -> Ended {
        let since = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return Ended { code: status.code(), stdout: self.text("stdout"), stderr: self.stderr() };
            }
            assert!(since.elapsed() < DEADLINE, "it does not end: {}", self.stderr());
            std::thread::sleep(CHECK_PERIOD);
        }
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        // A run needs time to clean up, which on a busy machine takes seconds. Browsers need this time, too, and so do programs
        // that wait for other programs before they end, such as `conicflow view`.
        let since = Instant::now();
        let is_running = |child: &mut Child| matches!(child.try_wait(), Ok(None));
        if is_running(&mut self.child) {
            signal(self.child.id(), Signal::TERM);
        }
        while is_running(&mut self.child) && since.elapsed() < DEADLINE {
            std::thread::sleep(CHECK_PERIOD);
        }
        let ends = !is_running(&mut self.child);
        self.child.kill().ok();
        self.child.wait().ok();
        assert!(ends || std::thread::panicking(), "it does not end when it is told to: {}", self.stderr());
    }
}

/// Waits until a condition holds.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let since = Instant::now();
    while !holds() {
        assert!(since.elapsed() < DEADLINE, "never came true: {what}");
        std::thread::sleep(CHECK_PERIOD);
    }
}

/// Row of a stage in the summary.
#[derive(Debug, PartialEq, Eq)]
pub struct StageRow {
    pub messages: u64,
    pub starts: u64,
}

/// Row of an input in the summary.
#[derive(Debug, PartialEq, Eq)]
pub struct InputRow {
    pub received: u64,
    pub dropped: u64,
    pub gaps: u64,
    pub late: u64,
}

impl Ended {
    /// Asserts that the program ended with this exit code.
    pub fn expect_code(self, code: i32) -> Self {
        assert_eq!(self.code, Some(code), "stdout: {}\nstderr: {}", self.stdout, self.stderr);
        self
    }

    /// Asserts that the program ended with exit code 0, or with exit code 1 and a report of the messages that a lossless reader
    /// has lost.
    pub fn expect_survived(self) -> Self {
        let has_losses = self.stderr.contains(" messages of the lossless topic `");
        self.expect_code(i32::from(has_losses))
    }

    /// Asserts that the standard error of the program contains each of these texts.
    pub fn expect_texts(&self, texts: &[&str]) {
        for text in texts {
            assert!(self.stderr.contains(text), "no `{text}` in: {}", self.stderr);
        }
    }

    /// The words of the rows of the summary's table that begins with `title`.
    fn table(&self, title: &str) -> impl Iterator<Item = Vec<&str>> {
        let rows = self.stderr.lines().skip_while(move |line| line.split_whitespace().next() != Some(title));
        rows.skip(1).take_while(|line| !line.is_empty()).map(|line| line.split_whitespace().collect())
    }

    /// Names of the stages in the summary.
    pub fn stages(&self) -> Vec<&str> {
        self.table("stage").map(|words| words[0]).collect()
    }

    pub fn stage(&self, name: &str) -> StageRow {
        let row = self.table("stage").find(|words| words[0] == name);
        let words = row.unwrap_or_else(|| panic!("no stage `{name}` in: {}", self.stderr));
        StageRow { messages: words[2].parse().unwrap(), starts: words[words.len() - 1].parse().unwrap() }
    }

    pub fn input(&self, topic: &str, reader: &str) -> InputRow {
        let row = self.table("topic").find(|words| words[..2] == [topic, reader]);
        let words = row.unwrap_or_else(|| panic!("no input of `{reader}` from `{topic}` in: {}", self.stderr));
        let number = |index: usize| words[index].parse().unwrap();
        InputRow { received: number(2), dropped: number(3), gaps: number(4), late: number(5) }
    }

    /// Asserts that a reader of a topic has received this number of messages, and missed none.
    pub fn expect_all(&self, topic: &str, reader: &str, received: u64) {
        let all = InputRow { received, dropped: 0, gaps: 0, late: 0 };
        assert_eq!(self.input(topic, reader), all, "{topic}, {reader}: {}", self.stderr);
    }
}
