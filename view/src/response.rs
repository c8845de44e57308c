//! Responses: written to their connection with a time limit, after which the connection is given up.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, ErrorKind, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// A browser that has not received a response after this time has stopped reading.
const TAKEN: Duration = Duration::from_secs(8);

/// Sent with every response: the page runs no foreign scripts, cannot be embedded in other pages, and is not cached.
const HEADERS: &str = "Cache-Control: no-store\r\n\
    Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
    frame-ancestors 'none'; base-uri 'none'; form-action 'none'\r\n\
    Cross-Origin-Resource-Policy: same-origin\r\n\
    Referrer-Policy: no-referrer\r\n\
    X-Content-Type-Options: nosniff\r\n\
    X-Frame-Options: DENY\r\n";

/// A response.
#[derive(Debug)]
pub struct Response {
    pub(crate) status: u16,
    kind: &'static str,
    headers: Vec<(&'static str, String)>,
    body: Cow<'static, [u8]>,
    is_head: bool,
}

impl Response {
    /// A response with this status and a body of this type.
    pub fn new(status: u16, kind: &'static str, body: impl Into<Cow<'static, [u8]>>) -> Self {
        Self { status, kind, headers: Vec::new(), body: body.into(), is_head: false }
    }

    /// A file of the page.
    pub(crate) fn file(kind: &'static str, content: &'static [u8]) -> Self {
        Self::new(200, kind, content)
    }

    /// A refusal with a line of text.
    pub fn refusal(status: u16, text: &str) -> Self {
        Self::new(status, "text/plain; charset=utf-8", format!("{text}\n").into_bytes())
    }

    /// A refusal because of too many requests, which may be retried.
    pub(crate) fn busy(text: &str) -> Self {
        Self::refusal(503, text).with_header("Retry-After", "2".to_owned())
    }

    /// A redirection to another path.
    pub(crate) fn moved(path: &'static str) -> Self {
        Self::refusal(303, "go on to the page").with_header("Location", path.to_owned())
    }

    /// Adds a header.
    pub(crate) fn with_header(mut self, name: &'static str, value: String) -> Self {
        self.headers.push((name, value));
        self
    }

    /// Drops the body, for a request with `HEAD`; the headers still give its length.
    pub(crate) fn without_body(mut self) -> Self {
        self.is_head = true;
        self
    }

    /// Writes the response, unless the browser does not receive it in time.
    pub(crate) fn write(&self, stream: &mut TcpStream, is_last: bool) -> io::Result<()> {
        let connection = if is_last { "close" } else { "keep-alive" };
        let (status, kind, length) = (self.status, self.kind, self.body.len());
        // The reason phrase after the status is optional (RFC 9112, section 4).
        let mut head = format!(
            "HTTP/1.1 {status} \r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: {connection}\r\n\
             {HEADERS}"
        );
        for (name, value) in &self.headers {
            // Writing to a string cannot fail.
            write!(head, "{name}: {value}\r\n").ok();
        }
        head.push_str("\r\n");
        let deadline = Instant::now() + TAKEN;
        write_all(stream, head.as_bytes(), deadline)?;
        write_all(stream, if self.is_head { &[] } else { &self.body }, deadline)
    }
}

/// Writes all bytes before the deadline, however few are accepted at a time.
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
