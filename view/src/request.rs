//! Requests: read from a connection with limits of time and size, and parsed by `httparse`.

use std::io::{self, ErrorKind, Read};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// Maximum length of a request without its body, in bytes.
const LONGEST_HEAD: usize = 8 * 1024;
/// Maximum length of a body, in bytes: it holds one command.
const LONGEST_BODY: usize = 1024;
/// Maximum number of headers.
const MOST_HEADERS: usize = 48;
/// An idle connection is closed after this time.
const IDLE: Duration = Duration::from_secs(20);
/// A request has to be complete after this time.
const WHOLE: Duration = Duration::from_secs(4);
/// Headers that may occur only once: a proxy might read another of several.
const ONCE: [&str; 3] = ["host", "content-length", "origin"];

/// A request.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Request {
    /// The method, such as `GET`; `HEAD` is handled like `GET`, without the body.
    pub method: String,
    /// The path, up to the question mark.
    pub path: String,
    query: String,
    headers: Vec<(String, String)>,
    pub(crate) is_head: bool,
    pub(crate) body: Vec<u8>,
}

/// Why there is no request.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum NoRequest {
    /// The connection has ended.
    Over,
    /// The input is answered with this status and text, and the connection is closed.
    Bad(u16, &'static str),
}

impl Request {
    /// Parses a request without its body; returns it with its length in bytes, or `None` if it is incomplete.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Option<(Self, usize)>, NoRequest> {
        let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
        let mut parsed = httparse::Request::new(&mut headers);
        let bad = |_| NoRequest::Bad(400, "this is no request of HTTP/1.1");
        let httparse::Status::Complete(length) = parsed.parse(bytes).map_err(bad)? else { return Ok(None) };
        let target = parsed.path.unwrap_or_default();
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let text = |value: &[u8]| String::from_utf8_lossy(value).trim().to_owned();
        let headers = parsed.headers.iter().map(|header| (header.name.to_ascii_lowercase(), text(header.value)));
        let is_head = parsed.method == Some("HEAD");
        let request = Self {
            method: if is_head { "GET" } else { parsed.method.unwrap_or_default() }.to_owned(),
            path: path.to_owned(),
            query: query.to_owned(),
            headers: headers.collect(),
            is_head,
            body: Vec::new(),
        };
        if ONCE.iter().any(|name| request.headers.iter().filter(|(known, _)| known == name).count() > 1) {
            return Err(NoRequest::Bad(400, "the request has a header twice that may be there but once"));
        }
        Ok(Some((request, length)))
    }

    /// Reads the next request of a connection; `rest` holds the bytes that came after the one before.
    pub(crate) fn read(stream: &mut TcpStream, rest: &mut Vec<u8>) -> Result<Self, NoRequest> {
        let mut deadline = Instant::now() + if rest.is_empty() { IDLE } else { WHOLE };
        let (mut request, length) = loop {
            if let Some(parsed) = Self::parse(rest)? {
                break parsed;
            }
            if rest.len() > LONGEST_HEAD {
                return Err(NoRequest::Bad(431, "the request is too long"));
            }
            let is_first = rest.is_empty();
            read_more(stream, rest, deadline)?;
            if is_first {
                deadline = Instant::now() + WHOLE;
            }
        };
        rest.drain(..length);
        let body = request.body_length()?;
        while rest.len() < body {
            read_more(stream, rest, deadline)?;
        }
        request.body = rest.drain(..body).collect();
        Ok(request)
    }

    fn body_length(&self) -> Result<usize, NoRequest> {
        if self.header("transfer-encoding").is_some() {
            return Err(NoRequest::Bad(411, "the request does not tell its length"));
        }
        let Some(length) = self.header("content-length") else { return Ok(0) };
        match length.parse() {
            Ok(length) if length <= LONGEST_BODY => Ok(length),
            Ok(_) => Err(NoRequest::Bad(413, "the request is too long")),
            Err(_) => Err(NoRequest::Bad(400, "the request has a length that is no number")),
        }
    }

    /// Returns the value of a header; `name` is in lower case.
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(known, _)| known == name).map(|(_, value)| value.as_str())
    }

    /// Returns a value of the query.
    pub(crate) fn query(&self, name: &str) -> Option<&str> {
        self.query
            .split('&')
            .filter_map(|pair| pair.split_once('='))
            .find(|(key, _)| *key == name)
            .map(|(_, value)| value)
    }

    /// Returns a number of the query, or 0 if there is none.
    pub(crate) fn number(&self, name: &str) -> u64 {
        self.query(name).and_then(|value| value.parse().ok()).unwrap_or(0)
    }

    /// Whether it only reads, and changes nothing.
    pub(crate) fn is_get(&self) -> bool {
        self.method == "GET"
    }

    /// Whether the connection is to be closed after it.
    pub(crate) fn is_last(&self) -> bool {
        self.header("connection").is_some_and(|value| value.eq_ignore_ascii_case("close"))
    }
}

/// Reads once before the deadline and appends the bytes.
fn read_more(stream: &mut TcpStream, bytes: &mut Vec<u8>, deadline: Instant) -> Result<(), NoRequest> {
    let left = deadline.saturating_duration_since(Instant::now());
    let late = if bytes.is_empty() { NoRequest::Over } else { NoRequest::Bad(408, "the request took too long") };
    if left.is_zero() {
        return Err(late);
    }
    let mut buffer = [0; 2048];
    let read = stream.set_read_timeout(Some(left)).and_then(|()| stream.read(&mut buffer));
    match read {
        Ok(0) => Err(NoRequest::Over),
        Ok(length) => {
            bytes.extend(&buffer[..length]);
            Ok(())
        }
        Err(error) if error.kind() == ErrorKind::Interrupted => Ok(()),
        Err(error) if is_timeout(&error) => Err(late),
        Err(_) => Err(NoRequest::Over),
    }
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_parsed() {
        let text = b"GET /look?browser=a1&frames=7 HTTP/1.1\r\nHost: localhost\r\nX-Odd:  y \r\n\r\nGET";
        let (request, length) = Request::parse(text).unwrap().unwrap();
        assert_eq!((request.path.as_str(), request.is_get(), length), ("/look", true, text.len() - 3));
        assert_eq!((request.query("browser"), request.number("frames")), (Some("a1"), 7));
        assert_eq!((request.number("told"), request.header("x-odd")), (0, Some("y")));
        assert_eq!(Request::parse(&text[..30]), Ok(None));
    }

    #[test]
    fn garbage_and_requests_that_are_too_long_are_refused() {
        assert!(matches!(Request::parse(b"\x16\x03\x01\x02\x00\x01\r\n\r\n"), Err(NoRequest::Bad(400, _))));
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(MOST_HEADERS + 1));
        assert!(matches!(Request::parse(many.as_bytes()), Err(NoRequest::Bad(400, _))));
        let length = |headers: &str| {
            let text = format!("POST /command HTTP/1.1\r\n{headers}\r\n\r\n");
            Request::parse(text.as_bytes()).unwrap().unwrap().0.body_length()
        };
        assert_eq!(length("Content-Length: 12"), Ok(12));
        assert!(matches!(length("Content-Length: 12000000"), Err(NoRequest::Bad(413, _))));
        assert!(matches!(length("Content-Length: -1"), Err(NoRequest::Bad(400, _))));
        assert!(matches!(length("Transfer-Encoding: chunked"), Err(NoRequest::Bad(411, _))));
    }

    #[test]
    fn headers_of_destination_origin_and_length_may_occur_only_once() {
        let parse = |headers: &str| Request::parse(format!("GET / HTTP/1.1\r\n{headers}\r\n\r\n").as_bytes());
        for headers in [
            "Host: 127.0.0.1\r\nHost: evil.example",
            "host: evil.example\r\nHost: 127.0.0.1",
            "Content-Length: 3\r\nContent-Length: 30",
            "Origin: http://127.0.0.1\r\nOrigin: http://evil.example",
        ] {
            assert!(matches!(parse(headers), Err(NoRequest::Bad(400, _))), "{headers}");
        }
        assert!(parse("Host: 127.0.0.1\r\nAccept: text/html\r\nAccept: */*").is_ok_and(|request| request.is_some()));
    }

    #[test]
    fn a_head_request_is_parsed_like_a_get_request() {
        let (request, _) = Request::parse(b"HEAD / HTTP/1.1\r\n\r\n").unwrap().unwrap();
        assert!(request.is_get() && request.is_head);
    }
}
