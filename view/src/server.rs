//! A small HTTP server with one thread per connection, which reads requests, has them answered, and ends with the connection. A
//! client that is slow or asks too much delays neither other clients nor the program that contains the server.

use crate::access::{Access, Listen};
use crate::request::{NoRequest, Request};
use crate::response::Response;
use conicflow_messages::Hinted;
use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

/// Maximum number of connections; a browser has up to six.
const MAX_CONNECTIONS: usize = 72;
/// The server itself answers at once, or has ended.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(1000);
/// Stack size of a connection's thread.
const STACK_BYTES: usize = 256 * 1024;
/// The niceness of threads that only display.
const NICENESS: i32 = 10;

/// Lowers the priority of this thread, and of those that it starts, in favour of stages. Has no effect if that is not allowed.
pub fn lower_priority() {
    // On Linux each thread has its own niceness.
    rustix::process::nice(NICENESS).ok();
}

/// Answers requests that have passed the access control.
pub trait Answer: Send + Sync + 'static {
    /// Answers a request.
    fn answer(&self, request: &Request) -> Response;
}

/// Why the server cannot start.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// It cannot listen at the address.
    #[error(transparent)]
    Address(Hinted),
    /// Its thread cannot be started.
    #[error("the server's thread cannot be started: {0}")]
    Thread(io::Error),
}

/// A server that runs until it is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    url: String,
    ends: Arc<AtomicBool>,
}

/// The state that the threads of connections share; each holds a reference while it runs.
struct Shared {
    answer: Box<dyn Answer>,
    access: Access,
}

impl Server {
    /// Starts a server at an address.
    ///
    /// # Errors
    /// The address is taken, or not this machine's.
    pub fn start(listen: &Listen, answer: impl Answer) -> Result<Self, ServeError> {
        let mut bound = TcpListener::bind(listen.address);
        if listen.or_any_port && bound.as_ref().is_err_and(|error| error.kind() == ErrorKind::AddrInUse) {
            bound = TcpListener::bind((listen.address.ip(), 0));
        }
        let bound = bound.and_then(|listener| Ok((listener.local_addr()?, listener)));
        let (address, listener) = bound.map_err(|error| ServeError::Address(address_fault(listen.address, &error)))?;
        let access = Access::new(listen, address);
        let shared = Arc::new(Shared { answer: Box::new(answer), access });
        let ends = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&ends);
        let accepting = thread::Builder::new().name("server".to_owned()).stack_size(STACK_BYTES);
        accepting.spawn(move || accept(&listener, &shared, &ended)).map_err(ServeError::Thread)?;
        Ok(Self { address, url: url(address, listen.token.as_deref()), ends })
    }

    /// The URL of the page, with its token if there is one.
    pub fn url(&self) -> &str {
        &self.url
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        // Connects once, because the thread waits for a connection.
        let own = match self.address.ip() {
            ip if ip.is_unspecified() => SocketAddr::from((Ipv4Addr::LOCALHOST, self.address.port())),
            _ => self.address,
        };
        TcpStream::connect_timeout(&own, CONNECT_TIMEOUT).ok();
    }
}

fn address_fault(address: SocketAddr, error: &io::Error) -> Hinted {
    let hint = match error.kind() {
        ErrorKind::AddrInUse => "another program is there; take another port",
        ErrorKind::AddrNotAvailable => "take an address of this machine, or 0.0.0.0 for all of them",
        ErrorKind::PermissionDenied => "ports below 1024 are for root; take a higher one",
        _ => "take another address",
    };
    Hinted::new(format!("nothing can be offered at {address}: {error}"), hint)
}

/// The URL to open in a browser. If the server listens at all addresses of the machine, the URL has the one that reaches the
/// network.
fn url(address: SocketAddr, token: Option<&str>) -> String {
    let ip = if address.ip().is_unspecified() { reachable(address.ip()) } else { address.ip() };
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    format!("http://{}/{token}", SocketAddr::from((ip, address.port())))
}

/// Returns the address from which this machine would send to the network. Connecting a UDP socket sends nothing.
fn reachable(unspecified: IpAddr) -> IpAddr {
    const DOCUMENTATION: (Ipv4Addr, u16) = (Ipv4Addr::new(192, 0, 2, 1), 9);
    let local_address = || {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        socket.connect(DOCUMENTATION)?;
        socket.local_addr()
    };
    local_address().map_or(unspecified, |own| own.ip())
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>, ends: &AtomicBool) {
    lower_priority();
    for stream in listener.incoming() {
        if ends.load(Ordering::Relaxed) {
            return;
        }
        match stream {
            Ok(stream) => begin(stream, shared),
            // There are no more file descriptors, or a browser left at once.
            Err(_) => thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// Starts the thread of a connection, unless there are too many.
fn begin(mut stream: TcpStream, shared: &Arc<Shared>) {
    stream.set_nodelay(true).ok();
    // The accepting thread holds one more reference.
    if Arc::strong_count(shared) > MAX_CONNECTIONS {
        let text = format!("{MAX_CONNECTIONS} connections are open already: close a page, or try again");
        // The socket's buffer is empty, so this does not block.
        Response::busy(&text).write(&mut stream, true).ok();
        stream.shutdown(Shutdown::Write).ok();
        return;
    }
    let shared = Arc::clone(shared);
    let connection = thread::Builder::new().name("connection".to_owned()).stack_size(STACK_BYTES);
    // If no thread can be started, the connection is closed.
    connection.spawn(move || serve(stream, &shared)).ok();
}

/// Answers the requests of a connection until it ends.
fn serve(mut stream: TcpStream, shared: &Shared) {
    let mut rest = Vec::new();
    loop {
        let (response, is_last) = match Request::read(&mut stream, &mut rest) {
            Ok(request) => {
                let refusal = shared.access.refusal(&request);
                let response = refusal.unwrap_or_else(|| shared.answer.answer(&request));
                (if request.is_head { response.without_body() } else { response }, request.is_last())
            }
            Err(NoRequest::Over) => return,
            Err(NoRequest::Bad(status, text)) => (Response::refusal(status, text), true),
        };
        if response.write(&mut stream, is_last).is_err() || is_last {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};

    struct Told;

    impl Answer for Told {
        fn answer(&self, request: &Request) -> Response {
            Response::new(if request.method == "GET" { 200 } else { 405 }, "text/plain", b"ten bytes.".as_slice())
        }
    }

    #[test]
    fn a_head_request_is_answered_without_the_body() {
        let server = Server::start(&Listen::open(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))), Told).unwrap();
        let answer = |method: &str| {
            let mut stream = TcpStream::connect(server.address).unwrap();
            write!(stream, "{method} / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").unwrap();
            let mut text = String::new();
            stream.read_to_string(&mut text).unwrap();
            text
        };
        let whole = answer("GET");
        assert!(whole.starts_with("HTTP/1.1 200 ") && whole.contains("Content-Length: 10\r\n"), "{whole}");
        assert_eq!(whole, format!("{}ten bytes.", answer("HEAD")));
    }
}
