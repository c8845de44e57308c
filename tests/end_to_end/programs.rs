//! Programs that the tests start beside `conicflow`: stages of a user's own, and a router. Each one is this test binary, started
//! with the one test whose body is the program. So only the tests have to be built.

use conicflow_dataflow::{Context, Output, SideInput, SideInputs, Stage, StageError, run_stage};
use conicflow_messages::{Ellipse, Header, Message, Nothing, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use std::time::Duration;

/// Environment variable with the endpoints on which the router listens, separated by `", "`.
const ROUTER: &str = "CONICFLOW_TEST_ROUTER";

/// The command of a program of this file, for `program =` in a pipeline file.
pub fn program(name: &str) -> String {
    let binary = std::env::current_exe().unwrap();
    format!("{:?}", [binary.to_str().unwrap(), "--ignored", "--nocapture", "--exact", &format!("programs::{name}")])
}

/// A Zenoh router that listens on these endpoints until it is killed.
pub fn router(endpoints: &[String]) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--ignored", "--nocapture", "--exact", "programs::run_router"]);
    command.env(ROUTER, endpoints.join("\", \""));
    command
}

/// Runs a stage if a launcher has started this process. The process then ends with the exit code that the `main` of the stage
/// would have, because a test that fails would have another one.
fn run<S: Stage>() {
    if std::env::var_os("CONICFLOW_STAGE").is_none() {
        return;
    }
    let ended = run_stage::<S>();
    let code = (0..=u8::MAX).find(|code| ExitCode::from(*code) == ended).unwrap();
    std::process::exit(i32::from(code));
}

#[test]
#[ignore = "a program that other tests start"]
fn faulty_stage() {
    run::<FaultyStage>();
}

#[test]
#[ignore = "a program that other tests start"]
fn pairing_sink() {
    run::<PairingSink>();
}

#[test]
#[ignore = "a program that other tests start"]
fn slow_sink() {
    run::<SlowSink>();
}

#[test]
#[ignore = "a program that other tests start"]
fn run_router() {
    let Ok(endpoints) = std::env::var(ROUTER) else { return };
    let _router = crate::routers::router(&endpoints);
    loop {
        std::thread::park();
    }
}

/// A stage that forwards its input. At some frames it panics, hangs without a heartbeat, or writes malformed objects.
struct FaultyStage(FaultyStageConfig);

/// Parameters of the faulty stage.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct FaultyStageConfig {
    /// Number of the first frame at which the stage panics.
    panic_at: Option<u64>,
    /// Number of frames after `panic_at` at which the stage panics, too.
    panics_more: u64,
    /// Number of the frame at which the stage hangs.
    hang_at: Option<u64>,
    /// Number of the first of three frames at which the stage writes a malformed object.
    nonsense_at: Option<u64>,
}

impl Stage for FaultyStage {
    const NAME: &'static str = "faulty_stage";
    const SUMMARY: &'static str = "Panics or hangs at one frame";
    type Config = FaultyStageConfig;
    type Input = Object;
    type Output = Object;

    fn new(config: FaultyStageConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self(config))
    }

    fn step(&mut self, input: &Message<Object>, _: &SideInputs, output: &mut Output<Object>) -> Result<(), StageError> {
        let frame = input.header.sequence;
        let panics = self.0.panic_at.map(|first| first..=first + self.0.panics_more);
        assert!(!panics.is_some_and(|frames| frames.contains(&frame)), "this frame is too much");
        if Some(frame) == self.0.hang_at {
            loop {
                std::thread::park();
            }
        }
        output.extend(input.items);
        let number = self.0.nonsense_at.and_then(|first| input.header.sequence.checked_sub(first));
        if let Some(object) = number.and_then(nonsense) {
            output.push(object);
        }
        Ok(())
    }
}

/// Malformed objects: with values that are not finite, with an unknown kind, and of random bits; `None` if there are no more.
fn nonsense(number: u64) -> Option<Object> {
    let mut object = Object::default();
    match number {
        0 => object.center = [f64::NAN; 3],
        1 => object.radius = f64::INFINITY,
        2 => bytemuck::bytes_of_mut(&mut object).fill(0xff),
        _ => return None,
    }
    Some(object)
}

/// Parameters of a sink that writes numbers.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct NumbersConfig {
    /// File for the numbers, one line per message.
    path: PathBuf,
    /// Time spent on each message, in milliseconds.
    delay_ms: u64,
}

impl Default for NumbersConfig {
    fn default() -> Self {
        Self { path: "numbers.txt".into(), delay_ms: 0 }
    }
}

/// The lines that a sink writes, each after its delay.
struct Numbers {
    file: File,
    delay: Duration,
}

impl Numbers {
    fn new(config: &NumbersConfig, context: &Context) -> Result<Self, StageError> {
        let file = File::options().create(true).append(true).open(context.resolve(&config.path))?;
        Ok(Self { file, delay: Duration::from_millis(config.delay_ms) })
    }

    fn write(&mut self, numbers: &str) -> Result<(), StageError> {
        writeln!(self.file, "{numbers}")?;
        std::thread::sleep(self.delay);
        Ok(())
    }
}

/// Writes the number of each image. A delay makes the sink so slow that it loses frames of a writer that does not wait for it.
struct SlowSink(Numbers);

impl Stage for SlowSink {
    const NAME: &'static str = "slow_sink";
    const SUMMARY: &'static str = "Takes its time over each depth image";
    type Config = NumbersConfig;
    type Input = u16;
    type Output = Nothing;

    fn new(config: NumbersConfig, context: &Context) -> Result<Self, StageError> {
        Numbers::new(&config, context).map(Self)
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.0.write(&input.header.sequence.to_string())
    }
}

/// Writes the number of each list of objects, and the numbers of the image and of the ellipses of the same frame, which are side
/// inputs of this sink.
struct PairingSink(Numbers);

impl Stage for PairingSink {
    const NAME: &'static str = "pairing_sink";
    const SUMMARY: &'static str = "Writes which messages came together";
    type Config = NumbersConfig;
    type Input = Object;
    type Output = Nothing;

    fn new(config: NumbersConfig, context: &Context) -> Result<Self, StageError> {
        Numbers::new(&config, context).map(Self)
    }

    fn side_inputs() -> &'static [SideInput] {
        const { &[SideInput::same_frame::<u16>("depth"), SideInput::same_frame::<Ellipse>("ellipses")] }
    }

    fn step(
        &mut self,
        input: &Message<Object>,
        side_inputs: &SideInputs,
        _: &mut Output<Nothing>,
    ) -> Result<(), StageError> {
        let number = |header: Option<&Header>| header.map_or("-".to_owned(), |header| header.sequence.to_string());
        let depth = number(side_inputs.get::<u16>("depth").map(|image| image.header));
        let ellipses = number(side_inputs.get::<Ellipse>("ellipses").map(|list| list.header));
        self.0.write(&format!("{} {depth} {ellipses}", input.header.sequence))
    }
}
