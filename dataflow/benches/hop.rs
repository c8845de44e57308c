//! Time of one hop from process to process, from before a message is sent to when its reader has it, woken by its coming:
//! a topic of this crate, beside a bare iceoryx2 service with an event, a Unix socket, and a plain copy of the same bytes.
//!
//! `cargo bench -p conicflow-dataflow --bench hop`; microseconds. All ways take turns, so that a busy machine harms them
//! alike; figures are medians over rounds.

use conicflow_dataflow::ports::shared_memory::SharedMemory;
use conicflow_dataflow::ports::{Delivery, Reader, Received, Topic, TopicReader, Transport, Writer};
use conicflow_dataflow::{Stop, monotonic_ns};
use conicflow_messages::Header;
use iceoryx2::prelude::{Config, FileName, Node, NodeBuilder, Path as RootPath, SemanticString, ServiceName, ipc};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::cell::RefCell;
use std::error::Error;
use std::hint::black_box;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

type Outcome<T> = Result<T, Box<dyn Error>>;

/// Bytes of a message: a short list to an image of 1280x960 depths of 32 bits.
const SIZES: [usize; 5] = [64, 4096, 65_536, 614_400, 4_915_200];
const ROUNDS: usize = 5;
/// Messages in a round.
const MESSAGES: usize = 300;
/// Long enough for a reader to fall asleep.
const PAUSE: Duration = Duration::from_millis(2);
/// Messages that wait for a reader that was held up.
const QUEUE: usize = 16;
/// A reader that has not got what it waits for by then has failed.
const PATIENCE: Duration = Duration::from_secs(20);

/// What the names of a bare service's files begin with.
const BARE_PREFIX: &[u8] = b"hop_";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    Topic,
    Bare,
    Socket,
}

const WAYS: [Way; 3] = [Way::Topic, Way::Bare, Way::Socket];

impl Way {
    fn name(self) -> &'static str {
        match self {
            Self::Topic => "topic",
            Self::Bare => "bare",
            Self::Socket => "socket",
        }
    }
}

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [_, "reader", way, bytes, folder] => read(way, bytes.parse()?, Path::new(folder)),
        _ => compare(),
    }
}

fn compare() -> Outcome<()> {
    println!("microseconds of a hop, medians of {ROUNDS} rounds of {MESSAGES} messages");
    println!(
        "{:>9}{:>10}{:>20}{:>20}{:>20}{:>17}",
        "bytes", "copy", "socket p50/p99", "iceoryx2 p50/p99", "topic p50/p99", "topic/iceoryx2"
    );
    for bytes in SIZES {
        let mut rounds: [Vec<[f64; 2]>; WAYS.len()] = Default::default();
        let mut copies = Vec::new();
        for _ in 0..ROUNDS {
            copies.push([copy_us(bytes), 0.0]);
            for (way, round) in WAYS.into_iter().zip(&mut rounds) {
                round.push(hop_us(way, bytes)?);
            }
        }
        let [topic, bare, socket] = rounds.each_ref().map(|rounds| [0, 1].map(|column| median(rounds, column)));
        let pair = |[p50, p99]: [f64; 2]| format!("{p50:.1} / {p99:.1}");
        let (copy, ratio) = (median(&copies, 0), topic[0] / bare[0]);
        println!("{bytes:>9}{copy:>10.1}{:>20}{:>20}{:>20}{ratio:>17.2}", pair(socket), pair(bare), pair(topic));
    }
    Ok(())
}

fn median(rounds: &[[f64; 2]], column: usize) -> f64 {
    let mut values: Vec<f64> = rounds.iter().map(|round| round[column]).collect();
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The median time of copying so many bytes.
fn copy_us(bytes: usize) -> f64 {
    let (from, mut to) = (vec![1_u8; bytes], vec![0_u8; bytes]);
    let copy = |_| {
        let start = Instant::now();
        black_box(&mut to).copy_from_slice(black_box(&from));
        [start.elapsed().as_secs_f64() * 1e6, 0.0]
    };
    median(&(0..MESSAGES).map(copy).collect::<Vec<_>>(), 0)
}

/// Median and 99th percentile of a round.
fn hop_us(way: Way, bytes: usize) -> Outcome<[f64; 2]> {
    let folder = Folder::new()?;
    match way {
        Way::Topic => send_by_topic(bytes, &folder),
        Way::Bare => send_bare(bytes, &folder),
        Way::Socket => send_by_socket(bytes, &folder),
    }
}

/// A folder for one round, in which its files are.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Outcome<Self> {
        let path = std::env::temp_dir().join(format!("hop-{}-{}", std::process::id(), monotonic_ns()));
        std::fs::create_dir_all(&path)?;
        Ok(Self(path))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // what is left in the folder for temporary files harms nobody
        let _ = std::fs::remove_dir_all(&self.0);
        // Of a bare service one file stays in shared memory, whose name does not change.
        let shared = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        let own = shared.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(BARE_PREFIX));
        own.for_each(|entry| drop(std::fs::remove_file(entry.path())));
    }
}

/// The reading process: it says a line when it is there, and one with its percentiles at the end.
struct ReadingProcess {
    child: Child,
    says: BufReader<ChildStdout>,
}

impl ReadingProcess {
    fn start(way: Way, bytes: usize, folder: &Folder) -> Outcome<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["reader", way.name(), &bytes.to_string()]).arg(&folder.0).stdout(Stdio::piped());
        let mut child = command.spawn()?;
        let says = BufReader::new(child.stdout.take().ok_or("the reader has no output")?);
        let mut reader = Self { child, says };
        reader.line()?;
        Ok(reader)
    }

    fn line(&mut self) -> Outcome<String> {
        let mut line = String::new();
        self.says.read_line(&mut line)?;
        Ok(line)
    }

    fn percentiles(mut self) -> Outcome<[f64; 2]> {
        let line = self.line()?;
        self.child.wait()?;
        let (p50, p99) = line.trim().split_once(' ').ok_or("the reader failed")?;
        Ok([p50.parse()?, p99.parse()?])
    }
}

fn read(way: &str, bytes: usize, folder: &Path) -> Outcome<()> {
    let mut times = match WAYS.into_iter().find(|known| known.name() == way) {
        Some(Way::Topic) => read_topic(folder)?,
        Some(Way::Bare) => read_bare(folder)?,
        Some(Way::Socket) => read_socket(bytes, folder)?,
        None => return Err(format!("there is no way `{way}`").into()),
    };
    times.sort_unstable();
    let at = |share: f64| times[(share * (times.len() - 1) as f64) as usize] as f64 * 1e-3;
    println!("{} {}", at(0.5), at(0.99));
    Ok(())
}

/// Receives what is there, then waits for more, until all have come; their ages in nanoseconds.
fn ages(wait: impl Fn() -> Outcome<()>, mut receive: impl FnMut() -> Outcome<Option<u64>>) -> Outcome<Vec<u64>> {
    println!("ready");
    let (mut ages, start) = (Vec::with_capacity(MESSAGES), Instant::now());
    while ages.len() < MESSAGES {
        if start.elapsed() > PATIENCE {
            return Err(format!("{} of {MESSAGES} messages came", ages.len()).into());
        }
        match receive()? {
            Some(sent) => ages.push(monotonic_ns() - sent),
            None => wait()?,
        }
    }
    Ok(ages)
}

fn topic() -> Topic {
    let reader = TopicReader { stage: "reader".into(), delivery: Delivery::Latest, queue: QUEUE };
    Topic { name: "hop".into(), item: None, writers: vec!["writer".into()], readers: vec![reader] }
}

fn send_by_topic(bytes: usize, folder: &Folder) -> Outcome<[f64; 2]> {
    let memory = SharedMemory::open(&folder.0, "hop", "writer", Stop::default())?;
    let mut writer = memory.writer::<u16>(&topic())?;
    writer.loan(bytes / 2)?.fill(7);
    let reader = ReadingProcess::start(Way::Topic, bytes, folder)?;
    for _ in 0..MESSAGES {
        sleep(PAUSE);
        writer.loan(bytes / 2)?[0] = 7;
        writer.send(&Header { stamp_ns: monotonic_ns(), ..Header::default() })?;
    }
    reader.percentiles()
}

fn read_topic(folder: &Path) -> Outcome<Vec<u64>> {
    let memory = SharedMemory::open(folder, "hop", "reader", Stop::default())?;
    let reader = RefCell::new(memory.reader::<u16>(&topic(), "reader")?);
    let wait = || Ok(reader.borrow_mut().wait(PAUSE * 10)?);
    ages(wait, || {
        let message = reader.borrow_mut().receive()?;
        Ok(message.map(|message| black_box(message.header().stamp_ns + u64::from(message.items::<u16>()[0]) - 7)))
    })
}

fn bare_node(folder: &Path) -> Outcome<Node<ipc::Service>> {
    let mut config = Config::default();
    config.global.set_root_path(&RootPath::new(folder.as_os_str().as_encoded_bytes())?);
    config.global.prefix = FileName::new(BARE_PREFIX)?;
    Ok(NodeBuilder::new().config(&config).create()?)
}

type BareMessages = PortFactory<ipc::Service, [u8], u64>;

fn bare_messages(node: &Node<ipc::Service>, name: &ServiceName) -> Outcome<BareMessages> {
    let builder = node.service_builder(name).publish_subscribe::<[u8]>().user_header::<u64>();
    Ok(builder.subscriber_max_buffer_size(QUEUE).open_or_create()?)
}

fn send_bare(bytes: usize, folder: &Folder) -> Outcome<[f64; 2]> {
    let (node, name) = (bare_node(&folder.0)?, ServiceName::new("hop")?);
    let messages = bare_messages(&node, &name)?;
    let publisher = messages.publisher_builder().initial_max_slice_len(bytes).create()?;
    let wake = node.service_builder(&name).event().open_or_create()?.notifier_builder().create()?;
    let reader = ReadingProcess::start(Way::Bare, bytes, folder)?;
    let mut sample = publisher.loan_slice(bytes)?;
    for _ in 0..MESSAGES {
        sleep(PAUSE);
        sample.payload_mut()[0] = 7;
        *sample.user_header_mut() = monotonic_ns();
        sample.send()?;
        wake.notify()?;
        // filled with zeros, outside what is measured
        sample = publisher.loan_slice(bytes)?;
    }
    drop(sample);
    reader.percentiles()
}

fn read_bare(folder: &Path) -> Outcome<Vec<u64>> {
    let (node, name) = (bare_node(folder)?, ServiceName::new("hop")?);
    let messages = bare_messages(&node, &name)?;
    let subscriber = messages.subscriber_builder().create()?;
    let wake = node.service_builder(&name).event().open_or_create()?.listener_builder().create()?;
    let wait = || Ok(wake.timed_wait(|_| {}, PAUSE * 10).map(drop)?);
    ages(wait, || {
        let sample = subscriber.receive()?;
        Ok(sample.map(|sample| black_box(*sample.user_header() + u64::from(sample.payload()[0]) - 7)))
    })
}

fn send_by_socket(bytes: usize, folder: &Folder) -> Outcome<[f64; 2]> {
    let listener = UnixListener::bind(folder.0.join("socket"))?;
    let reader = ReadingProcess::start(Way::Socket, bytes, folder)?;
    let (mut socket, _) = listener.accept()?;
    let mut message = vec![7; bytes];
    for _ in 0..MESSAGES {
        sleep(PAUSE);
        message[..8].copy_from_slice(&monotonic_ns().to_ne_bytes());
        socket.write_all(&message)?;
    }
    reader.percentiles()
}

fn read_socket(bytes: usize, folder: &Path) -> Outcome<Vec<u64>> {
    let mut socket = UnixStream::connect(folder.join("socket"))?;
    let mut message = vec![0; bytes];
    ages(
        || Ok(()),
        || {
            socket.read_exact(&mut message)?;
            Ok(Some(u64::from_ne_bytes(message[..8].try_into()?)))
        },
    )
}
