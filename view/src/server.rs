//! Hands what is to be seen to browsers: a thread for each connection, which waits for a request, answers it, and ends with it.
//!
//! A browser asks for what it has not seen yet (`/look`), and gets it as soon as it is there; when it has drawn it, it asks anew. So
//! a slow browser leaves frames out, and a browser that is gone asks for none.

use crate::access::{Access, Listen};
use crate::display::Display;
use crate::page;
use crate::request::{NoRequest, Request};
use crate::response::Response;
use conicflow_messages::Hinted;
use serde_json::json;
use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

/// No more connections than this; a browser has up to six.
const MAX_CONNECTIONS: usize = 72;
/// A request that nothing new comes for is answered after this time.
const PATIENCE: Duration = Duration::from_millis(1000);
/// How long the name is that a browser gives itself, at most.
const LONGEST_NAME: usize = 40;
/// What a thread of a connection needs.
const STACK_BYTES: usize = 256 * 1024;
/// Who shows gives way to those at work.
const NICENESS: i32 = 10;
/// What is sent to a browser begins with a text, whose length is a multiple of this.
const ALIGNMENT: usize = 4;

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address cannot be listened at.
    #[error(transparent)]
    Address(Hinted),
    /// No thread can be started.
    #[error("the page's thread cannot be started: {0}")]
    Thread(io::Error),
}

/// A page that is offered until this is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    url: String,
    ends: Arc<AtomicBool>,
}

/// What the threads of connections share.
struct Shared {
    display: Arc<Display>,
    access: Access,
    connections: AtomicUsize,
}

impl Server {
    /// Offers a page with what a display shows.
    ///
    /// # Errors
    /// The address is taken, or not this machine's.
    pub fn start(listen: &Listen, display: Arc<Display>) -> Result<Self, ServeError> {
        let mut bound = TcpListener::bind(listen.address);
        if listen.or_any_port && bound.as_ref().is_err_and(|error| error.kind() == ErrorKind::AddrInUse) {
            bound = TcpListener::bind((listen.address.ip(), 0));
        }
        let bound = bound.and_then(|listener| Ok((listener.local_addr()?, listener)));
        let (address, listener) = bound.map_err(|error| ServeError::Address(address_fault(listen.address, &error)))?;
        let access = Access::new(listen.token.clone(), address.port());
        let shared = Arc::new(Shared { display, access, connections: AtomicUsize::new(0) });
        let ends = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&ends);
        let accepting = thread::Builder::new().name("view".to_owned()).stack_size(STACK_BYTES);
        accepting.spawn(move || accept(&listener, &shared, &ended)).map_err(ServeError::Thread)?;
        Ok(Self { address, url: url(address, listen.token.as_deref()), ends })
    }

    /// Where the page is, with the token that is asked for there.
    pub fn url(&self) -> &str {
        &self.url
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        // The thread waits for a connection; this is one.
        let own = match self.address.ip() {
            ip if ip.is_unspecified() => SocketAddr::from((Ipv4Addr::LOCALHOST, self.address.port())),
            _ => self.address,
        };
        TcpStream::connect_timeout(&own, PATIENCE).ok();
    }
}

fn address_fault(address: SocketAddr, error: &io::Error) -> Hinted {
    let hint = match error.kind() {
        ErrorKind::AddrInUse => "another program is there; take another port",
        ErrorKind::AddrNotAvailable => "take an address of this machine, or 0.0.0.0 for all of them",
        ErrorKind::PermissionDenied => "ports below 1024 are for root; take a higher one",
        _ => "take another address",
    };
    Hinted::new(format!("the page cannot be offered at {address}: {error}"), hint)
}

/// The address to open in a browser. Of a machine that listens at all its addresses, the one by which it reaches others.
fn url(address: SocketAddr, token: Option<&str>) -> String {
    let ip = if address.ip().is_unspecified() { reachable(address.ip()) } else { address.ip() };
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    format!("http://{}/{token}", SocketAddr::from((ip, address.port())))
}

/// The address from which this machine would send to the network: asking for the way sends nothing.
fn reachable(unspecified: IpAddr) -> IpAddr {
    const DOCUMENTATION: (Ipv4Addr, u16) = (Ipv4Addr::new(192, 0, 2, 1), 9);
    let way = || {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        socket.connect(DOCUMENTATION)?;
        socket.local_addr()
    };
    way().map_or(unspecified, |own| own.ip())
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>, ends: &AtomicBool) {
    // On Linux a thread has a niceness of its own, and those that it starts have the same.
    rustix::process::nice(NICENESS).ok();
    for stream in listener.incoming() {
        if ends.load(Ordering::Relaxed) {
            return;
        }
        match stream {
            Ok(stream) => begin(stream, shared),
            // Out of file descriptors, or a browser that left at once.
            Err(_) => thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// Starts the thread of a connection, unless there are enough.
fn begin(mut stream: TcpStream, shared: &Arc<Shared>) {
    stream.set_nodelay(true).ok();
    if shared.connections.fetch_add(1, Ordering::Relaxed) >= MAX_CONNECTIONS {
        shared.connections.fetch_sub(1, Ordering::Relaxed);
        let text = format!("{MAX_CONNECTIONS} connections are open already: close a page, or try again");
        // It goes into the socket's buffer, which is empty: nobody is waited for.
        busy(&text).write(&mut stream, true).ok();
        stream.shutdown(Shutdown::Write).ok();
        return;
    }
    let of_thread = Arc::clone(shared);
    let started = thread::Builder::new().name("browser".to_owned()).stack_size(STACK_BYTES).spawn(move || {
        serve(stream, &of_thread);
        of_thread.connections.fetch_sub(1, Ordering::Relaxed);
    });
    if started.is_err() {
        shared.connections.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Answers the requests of a connection until it is over.
fn serve(mut stream: TcpStream, shared: &Shared) {
    let mut rest = Vec::new();
    loop {
        let (response, is_last) = match Request::read(&mut stream, &mut rest) {
            Ok(request) => (shared.answer(&request), request.is_last()),
            Err(NoRequest::Over) => return,
            Err(NoRequest::Bad(status, text)) => (Response::refusal(status, text), true),
        };
        if response.write(&mut stream, is_last).is_err() || is_last {
            return;
        }
    }
}

fn busy(text: &str) -> Response {
    Response::refusal(503, text).with_header("Retry-After", "2".to_owned())
}

impl Shared {
    fn answer(&self, request: &Request) -> Response {
        if let Some(refusal) = self.access.refusal(request) {
            return refusal;
        }
        match (request.method.as_str(), request.path.as_str()) {
            ("GET", "/look") => self.look(request),
            ("POST", "/command") => self.command(request),
            ("GET", path) => match page::file(path) {
                Some((kind, content)) => Response::file(kind, content),
                None => Response::refusal(404, "there is nothing here; the page is at /"),
            },
            _ => Response::refusal(405, "this is not done here"),
        }
    }

    /// What a browser has not seen: the length of a text in four bytes, the text in JSON, the depths of the pixels.
    fn look(&self, request: &Request) -> Response {
        let browser = request.query("browser").unwrap_or_default();
        if browser.is_empty() || browser.len() > LONGEST_NAME {
            return Response::refusal(400, "a browser gives itself a name of up to 40 letters");
        }
        let look = self.display.look(browser, request.number("frames"), request.number("told"), PATIENCE);
        let look = match look {
            Ok(look) => look,
            Err(too_many) => {
                return busy(&format!("{} browsers look already: close one of them", too_many.limit));
            }
        };
        let columns = u32::try_from(request.number("columns")).unwrap_or(u32::MAX);
        let step = look.frame.as_ref().map_or(1, |frame| frame.step(columns));
        let json = json!({
            "frames": look.frames,
            "frame": look.frame.as_ref().map(|frame| frame.to_json(step)),
            "told": look.told,
            "about": look.about.as_deref(),
            "player": look.player,
        });
        let mut text = json.to_string();
        text.extend(std::iter::repeat_n(' ', text.len().next_multiple_of(ALIGNMENT) - text.len()));
        // No text is that long: a list has a few hundred items, each of some kilobytes.
        let mut bytes = u32::try_from(text.len()).unwrap_or(0).to_le_bytes().to_vec();
        bytes.extend(text.as_bytes());
        if let Some(frame) = &look.frame {
            frame.write_pixels(step, &mut bytes);
        }
        Response::new(200, "application/octet-stream", bytes)
    }

    fn command(&self, request: &Request) -> Response {
        if request.header("content-type") != Some("application/json") {
            return Response::refusal(415, "a wish is told in JSON");
        }
        match serde_json::from_slice(&request.body) {
            Ok(command) => {
                self.display.wish(command);
                Response::new(204, "text/plain; charset=utf-8", Vec::new())
            }
            Err(error) => Response::refusal(400, &format!("no wish that is known: {error}")),
        }
    }
}
