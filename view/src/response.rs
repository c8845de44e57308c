//! What a request is answered: written to its connection within a time, or the connection is given up.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, ErrorKind, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// A browser that has not taken an answer by then has stopped reading.
const TAKEN: Duration = Duration::from_secs(8);

/// Sent with every answer: nothing from elsewhere runs in the page, nobody puts it into a page of theirs, and nothing is kept.
const HEADERS: &str = "Cache-Control: no-store\r\n\
    Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
    frame-ancestors 'none'; base-uri 'none'; form-action 'none'\r\n\
    Cross-Origin-Resource-Policy: same-origin\r\n\
    Referrer-Policy: no-referrer\r\n\
    X-Content-Type-Options: nosniff\r\n\
    X-Frame-Options: DENY\r\n";

/// An answer.
#[derive(Debug)]
pub struct Response {
    pub(crate) status: u16,
    kind: &'static str,
    headers: Vec<(&'static str, String)>,
    body: Cow<'static, [u8]>,
    is_head: bool,
}

impl Response {
    /// An answer with this status and a body of this kind.
    pub fn new(status: u16, kind: &'static str, body: impl Into<Cow<'static, [u8]>>) -> Self {
        Self { status, kind, headers: Vec::new(), body: body.into(), is_head: false }
    }

    /// A file of the page.
    pub(crate) fn file(kind: &'static str, content: &'static [u8]) -> Self {
        Self::new(200, kind, content)
    }

    /// Why there is no better answer, in a line.
    pub fn refusal(status: u16, text: &str) -> Self {
        Self::new(status, "text/plain; charset=utf-8", format!("{text}\n").into_bytes())
    }

    /// Too many ask; it may be tried again.
    pub(crate) fn busy(text: &str) -> Self {
        Self::refusal(503, text).with_header("Retry-After", "2".to_owned())
    }

    /// What was asked for is at another path.
    pub(crate) fn moved(path: &'static str) -> Self {
        Self::refusal(303, "go on to the page").with_header("Location", path.to_owned())
    }

    /// The same with a header more.
    pub(crate) fn with_header(mut self, name: &'static str, value: String) -> Self {
        self.headers.push((name, value));
        self
    }

    /// The same for who asks for its head alone, which tells the length that the body has.
    pub(crate) fn without_body(mut self) -> Self {
        self.is_head = true;
        self
    }

    /// Writes it, unless the browser does not take it in time.
    pub(crate) fn write(&self, stream: &mut TcpStream, is_last: bool) -> io::Result<()> {
        let connection = if is_last { "close" } else { "keep-alive" };
        let (status, kind, length) = (self.status, self.kind, self.body.len());
        // The words behind the status mean nothing, and need not be there (RFC 9112, section 4).
        let mut head = format!(
            "HTTP/1.1 {status} \r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: {connection}\r\n\
             {HEADERS}"
        );
        for (name, value) in &self.headers {
            // A text grows without fail.
            write!(head, "{name}: {value}\r\n").ok();
        }
        head.push_str("\r\n");
        let deadline = Instant::now() + TAKEN;
        write_all(stream, head.as_bytes(), deadline)?;
        write_all(stream, if self.is_head { &[] } else { &self.body }, deadline)
    }
}

/// Writes all until the deadline, however little is taken at a time.
fn write_all(stream: &mut TcpStream, mut bytes: &[u8], deadline: Instant) -> io::Result<()> {
    while !bytes.is_empty() {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(ErrorKind::TimedOut.into());
        }
        stream.set_write_timeout(Some(left))?;
        match stream.write(bytes) {
            Ok(0) => return Err(ErrorKind::WriteZero.into()),
            Ok(written) => bytes = &bytes[written..],
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
