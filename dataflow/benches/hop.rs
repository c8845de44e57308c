//! Time of one hop between processes: from before a message is sent until its reader, which it wakes, has it. Compares a topic of
//! this crate, a bare iceoryx2 service with an event, a Unix socket, and a plain copy of the same bytes. Also the cost of keeping
//! the messages of a lossless topic until its reader has finished them: the same hop with and without, and the time per message
//! when both sides run at full speed, one filling messages and the other reading them completely.
//!
//! `cargo bench -p conicflow-dataflow --bench hop`; microseconds. All ways take turns, so that load on the machine affects them
//! alike; figures are medians over rounds.

use conicflow_dataflow::ports::shared_memory::{SharedMemory, SharedWriter};
use conicflow_dataflow::ports::{Delivery, Reader, Received, Topic, TopicReader, Transport, Writer};
use conicflow_dataflow::{ItemType, Stop, monotonic_ns};
use conicflow_messages::{Header, Hop, Text};
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
/// Number of rounds.
const ROUNDS: usize = 5;
/// Number of messages in a round.
const MESSAGES: usize = 300;
/// Pause between messages that is long enough for a reader to fall asleep.
const PAUSE: Duration = Duration::from_millis(2);
/// Queue length, for a reader that is delayed.
const QUEUE: usize = 16;
/// Queue length of a lossless reader: the default of a pipeline file.
const LOSSLESS_QUEUE: usize = 4;
const WRITER: &str = "writer";
/// Timeout after which a waiting reader has failed.
const PATIENCE: Duration = Duration::from_secs(20);

/// Prefix of a bare service's files.
const BARE_PREFIX: &[u8] = b"hop_";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    Topic,
    Bare,
    Socket,
    Lossless,
    Kept,
}

const WAYS: [Way; 5] = [Way::Topic, Way::Bare, Way::Socket, Way::Lossless, Way::Kept];

impl Way {
    fn name(self) -> &'static str {
        match self {
            Self::Topic => "topic",
            Self::Bare => "bare",
            Self::Socket => "socket",
            Self::Lossless => "lossless",
            Self::Kept => "kept",
        }
    }
}

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [_, "reader", way, bytes, folder] => read(way, bytes.parse()?, Path::new(folder)),
        [_, "taker", way, folder] => take(way, Path::new(folder)),
        _ => compare(),
    }
}

fn compare() -> Outcome<()> {
    println!("microseconds of a hop, medians of {ROUNDS} rounds of {MESSAGES} messages");
    println!(
        "{:>9}{:>10}{:>20}{:>20}{:>20}{:>17}{:>20}{:>20}{:>15}{:>17}{:>17}{:>15}",
        "bytes",
        "copy",
        "socket p50/p99",
        "iceoryx2 p50/p99",
        "topic p50/p99",
        "topic/iceoryx2",
        "lossless p50/p99",
        "kept p50/p99",
        "kept/lossless",
        "at full speed",
        "kept",
        "kept/lossless"
    );
    for bytes in SIZES {
        let mut rounds: [Vec<[f64; 2]>; WAYS.len()] = Default::default();
        let (mut copies, mut full_speed) = (Vec::new(), Vec::new());
        for _ in 0..ROUNDS {
            full_speed.push([message_us(Way::Lossless, bytes)?, message_us(Way::Kept, bytes)?]);
            copies.push([copy_us(bytes), 0.0]);
            for (way, round) in WAYS.into_iter().zip(&mut rounds) {
                round.push(hop_us(way, bytes)?);
            }
        }
        let [topic, bare, socket, lossless, kept] =
            rounds.each_ref().map(|rounds| [0, 1].map(|column| median(rounds, column)));
        let pair = |[p50, p99]: [f64; 2]| format!("{p50:.1} / {p99:.1}");
        let (copy, ratio) = (median(&copies, 0), topic[0] / bare[0]);
        print!("{bytes:>9}{copy:>10.1}{:>20}{:>20}{:>20}{ratio:>17.2}", pair(socket), pair(bare), pair(topic));
        print!("{:>20}{:>20}{:>15.2}", pair(lossless), pair(kept), kept[0] / lossless[0]);
        let [without, with] = [0, 1].map(|column| median(&full_speed, column));
        println!("{without:>17.1}{with:>17.1}{:>15.2}", with / without);
    }
    Ok(())
}

fn median(rounds: &[[f64; 2]], column: usize) -> f64 {
    let mut values: Vec<f64> = rounds.iter().map(|round| round[column]).collect();
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Median time of copying this many bytes.
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
        Way::Topic | Way::Lossless | Way::Kept => send_by_topic(way, bytes, &folder),
        Way::Bare => send_bare(bytes, &folder),
        Way::Socket => send_by_socket(bytes, &folder),
    }
}

/// Folder for the files of one round.
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
        // leftovers in the folder for temporary files do no harm
        let _ = std::fs::remove_dir_all(&self.0);
        // A bare service leaves one file in shared memory, whose name does not change.
        let shared = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        let own = shared.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(BARE_PREFIX));
        own.for_each(|entry| drop(std::fs::remove_file(entry.path())));
    }
}

/// The reading process: it prints a line when it is ready, and one with its percentiles at the end.
struct ReadingProcess {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl ReadingProcess {
    fn start(way: Way, bytes: usize, folder: &Folder) -> Outcome<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["reader", way.name(), &bytes.to_string()]).arg(&folder.0).stdout(Stdio::piped());
        let mut child = command.spawn()?;
        let output = BufReader::new(child.stdout.take().ok_or("the reader has no output")?);
        let mut reader = Self { child, output };
        reader.line()?;
        Ok(reader)
    }

    fn line(&mut self) -> Outcome<String> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
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
        Some(way @ (Way::Topic | Way::Lossless | Way::Kept)) => read_topic(way, folder)?,
        Some(Way::Bare) => read_bare(folder)?,
        Some(Way::Socket) => read_socket(bytes, folder)?,
        None => return Err(format!("there is no way `{way}`").into()),
    };
    times.sort_unstable();
    let at = |share: f64| times[(share * (times.len() - 1) as f64) as usize] as f64 * 1e-3;
    println!("{} {}", at(0.5), at(0.99));
    Ok(())
}

/// Receives messages, waiting for more, until all have come. Returns their ages in nanoseconds.
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

fn topic(way: Way) -> Topic {
    let (delivery, queue) =
        if way == Way::Topic { (Delivery::Latest, QUEUE) } else { (Delivery::Lossless, LOSSLESS_QUEUE) };
    let reader = TopicReader { stage: "reader".into(), delivery, queue };
    Topic { name: "hop".into(), item: Some(ItemType::of::<u16>()), writers: vec![WRITER.into()], readers: vec![reader] }
}

fn memory(way: Way, folder: &Path, stage: &str) -> Outcome<SharedMemory> {
    let memory = SharedMemory::open(folder, "hop", stage, Stop::default())?;
    Ok(if way == Way::Kept { memory.kept_in(folder) } else { memory })
}

/// Sends a message as a stage does, once a lossless reader has room.
fn send(writer: &mut SharedWriter, number: u64) -> Outcome<()> {
    while writer.unfinished("reader") > LOSSLESS_QUEUE {
        writer.wait(PAUSE);
    }
    let mut header = Header { stamp_ns: monotonic_ns(), number, ..Header::default() };
    header.add_hop(Hop { stage: Text::new(WRITER), ..Hop::default() });
    writer.send(&header)?;
    Ok(())
}

fn send_by_topic(way: Way, bytes: usize, folder: &Folder) -> Outcome<[f64; 2]> {
    let _services = memory(way, &folder.0, "launcher")?.keep_services([topic(way)].iter())?;
    let mut writer = memory(way, &folder.0, WRITER)?.writer::<u16>(&topic(way))?;
    writer.loan(bytes / 2)?.fill(7);
    let reader = ReadingProcess::start(way, bytes, folder)?;
    for number in 0..MESSAGES as u64 {
        sleep(PAUSE);
        writer.loan(bytes / 2)?[0] = 7;
        send(&mut writer, number)?;
    }
    reader.percentiles()
}

fn read_topic(way: Way, folder: &Path) -> Outcome<Vec<u64>> {
    let memory = memory(way, folder, "reader")?;
    let reader = RefCell::new(memory.reader::<u16>(&topic(way), "reader")?);
    let wait = || Ok(reader.borrow_mut().wait(PAUSE * 10)?);
    ages(wait, || {
        let Some(message) = reader.borrow_mut().receive()? else { return Ok(None) };
        let (sent, number) = (message.header().stamp_ns, message.header().number);
        black_box(message.items::<u16>()[0]);
        reader.borrow_mut().acknowledge(Text::new(WRITER), number + 1);
        Ok(Some(sent))
    })
}

/// Time per message when the writer fills one after the other, and the reader reads them.
fn message_us(way: Way, bytes: usize) -> Outcome<f64> {
    let folder = Folder::new()?;
    let _services = memory(way, &folder.0, "launcher")?.keep_services([topic(way)].iter())?;
    let mut writer = memory(way, &folder.0, WRITER)?.writer::<u16>(&topic(way))?;
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["taker", way.name()]).arg(&folder.0).stdout(Stdio::piped());
    let mut child = command.spawn()?;
    let output = BufReader::new(child.stdout.take().ok_or("the reader has no output")?);
    let mut reader = ReadingProcess { child, output };
    reader.line()?;
    let start = Instant::now();
    for number in 0..MESSAGES as u64 {
        writer.loan(bytes / 2)?.fill(number as u16);
        send(&mut writer, number)?;
    }
    reader.line()?;
    reader.child.wait()?;
    Ok(start.elapsed().as_secs_f64() * 1e6 / MESSAGES as f64)
}

/// Reads all messages, and prints a line when done.
fn take(way: &str, folder: &Path) -> Outcome<()> {
    let way = if way == Way::Kept.name() { Way::Kept } else { Way::Lossless };
    let memory = memory(way, folder, "reader")?;
    let mut reader = memory.reader::<u16>(&topic(way), "reader")?;
    println!("ready");
    let (mut taken, start) = (0, Instant::now());
    while taken < MESSAGES {
        if start.elapsed() > PATIENCE {
            return Err(format!("{taken} of {MESSAGES} messages came").into());
        }
        let Some(message) = reader.receive()? else {
            reader.wait(PAUSE * 10)?;
            continue;
        };
        let sum: u64 = message.items::<u16>().iter().map(|&pixel| u64::from(pixel)).sum();
        assert_eq!(sum, (taken * message.items::<u16>().len()) as u64, "what is read was overwritten");
        drop(message);
        taken += 1;
        reader.acknowledge(Text::new(WRITER), taken as u64);
    }
    println!("done");
    Ok(())
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
        // filled with zeros outside of the measurement
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
