//! Access control: the address of the page, and which requests are answered there.
//!
//! At a loopback address every user of this machine has access, but no foreign web page has: neither by a host name of its own
//! that leads here (DNS rebinding, detected by `Host`) nor by requests that it makes its visitors send (detected by `Origin` and
//! `Sec-Fetch-Site`). At any other address a token is required, which is passed once in the URL of the page and then as a cookie,
//! or by a program in `Authorization: Bearer`; unless the page is open to everyone.

use crate::request::Request;
use crate::response::Response;
use conicflow_messages::Hinted;
use std::fs::File;
use std::io::{self, Read};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// Shorter tokens could be guessed.
const SHORTEST_TOKEN: usize = 12;
/// The default port of the page.
const DEFAULT_PORT: u16 = 8760;

/// The address of the page, and its token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listen {
    /// The address.
    pub address: SocketAddr,
    /// The token that is required; `None` at a loopback address by default, and where everyone has access.
    pub token: Option<String>,
    /// Whether another port may be used if this one is taken.
    pub or_any_port: bool,
}

/// Why the page cannot be served there.
#[derive(Debug, thiserror::Error)]
pub enum ListenFault {
    /// The text is no address or no token.
    #[error(transparent)]
    Text(#[from] Hinted),
    /// A token cannot be generated.
    #[error("`/dev/urandom` cannot be read for a token: {0}")]
    Token(#[from] io::Error),
}

impl Listen {
    /// Parses `ADDRESS`, `ADDRESS:PORT` or `:PORT`; the default is a loopback address. If other machines can connect and no token
    /// is given, one is generated.
    ///
    /// # Errors
    /// The text is no address, or the token is too short.
    pub fn read(address: Option<&str>, token: Option<&str>) -> Result<Self, ListenFault> {
        let socket = address.map_or(Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, DEFAULT_PORT))), read_address)?;
        let is_loopback = socket.ip().is_loopback();
        let token = match token {
            Some(token) => Some(check_token(token)?),
            None if is_loopback => None,
            None => Some(make_token()?),
        };
        Ok(Self { address: socket, token, or_any_port: address.is_none() })
    }

    /// This address only, with access for everyone who can reach it.
    pub fn open(address: SocketAddr) -> Self {
        Self { address, token: None, or_any_port: false }
    }
}

fn read_address(text: &str) -> Result<SocketAddr, Hinted> {
    let with_port = text.parse::<SocketAddr>().ok();
    let alone = || text.parse::<IpAddr>().ok().map(|address| SocketAddr::from((address, DEFAULT_PORT)));
    let port = || text.strip_prefix(':')?.parse().ok().map(|port: u16| SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
    with_port.or_else(alone).or_else(port).ok_or_else(|| {
        let what = format!("`{text}` is no address, expected ADDRESS or ADDRESS:PORT in numbers");
        Hinted::new(what, "127.0.0.1:8760 is seen on this machine alone, 0.0.0.0 in its whole network")
    })
}

fn check_token(token: &str) -> Result<String, Hinted> {
    let is_plain = token.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_');
    if token.len() < SHORTEST_TOKEN || !is_plain {
        let what = format!("the token is not at least {SHORTEST_TOKEN} letters, digits, `-` or `_`");
        return Err(Hinted::new(what, "such as what `openssl rand -hex 16` prints"));
    }
    Ok(token.to_owned())
}

/// Generates 128 random bits.
fn make_token() -> io::Result<String> {
    let mut bytes = [0; 16];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Decides which requests are answered.
#[derive(Debug)]
pub(crate) struct Access {
    token: Option<String>,
    /// Whether any host name is accepted.
    is_open: bool,
    /// The name of the cookie with the token; pages at other ports of the same machine have other names.
    cookie: String,
}

impl Access {
    /// Creates the access rules for `listen` at the actual address.
    pub(crate) fn new(listen: &Listen, address: SocketAddr) -> Self {
        let token = listen.token.clone();
        let is_open = token.is_none() && !address.ip().is_loopback();
        Self { token, is_open, cookie: format!("conicflow_{}", address.port()) }
    }

    /// Returns `None` if a request may be answered, else the response that refuses it.
    pub(crate) fn refusal(&self, request: &Request) -> Option<Response> {
        let Some(host) = request.header("host") else {
            return Some(Response::refusal(400, "the request has no Host"));
        };
        let own = format!("http://{host}");
        if request.header("origin").is_some_and(|origin| !origin.eq_ignore_ascii_case(&own)) {
            return Some(Response::refusal(403, "the request comes from another page"));
        }
        let is_visit = request.is_get() && request.path == "/";
        let is_own_page = matches!(request.header("sec-fetch-site"), None | Some("same-origin" | "none"));
        if !is_visit && !is_own_page {
            return Some(Response::refusal(403, "the request comes from another site"));
        }
        match &self.token {
            Some(token) => self.token_refusal(request, token),
            None if self.is_open || is_loopback_name(host) => None,
            None => Some(Response::refusal(
                403,
                "this page is for this machine alone: open it as http://127.0.0.1 or localhost",
            )),
        }
    }

    /// Checks the token of a request. A request with the token in the URL of the page is redirected to the page without it, and
    /// gets it as a cookie.
    fn token_refusal(&self, request: &Request, token: &str) -> Option<Response> {
        let brought = request.query("token");
        if request.path == "/" && brought.is_some_and(|brought| is_same(brought, token)) {
            let cookie = format!("{}={token}; Path=/; HttpOnly; SameSite=Strict", self.cookie);
            return Some(Response::moved("/").with_header("Set-Cookie", cookie));
        }
        let cookies = request.header("cookie").unwrap_or_default().split(';');
        let kept = cookies.filter_map(|cookie| cookie.trim().split_once('=')).find(|(name, _)| *name == self.cookie);
        if kept.is_some_and(|(_, kept)| is_same(kept, token)) {
            return None;
        }
        let of_program = request.header("authorization").and_then(|text| text.split_once(' '));
        if of_program.is_some_and(|(kind, sent)| kind.eq_ignore_ascii_case("bearer") && is_same(sent.trim(), token)) {
            return None;
        }
        let what = if brought.is_some() { "the token is wrong" } else { "a token is needed" };
        Some(Response::refusal(
            401,
            &format!(
                "{what}: open the address that was printed, with `?token=`, or send `Authorization: Bearer TOKEN`"
            ),
        ))
    }
}

/// Whether a `Host`, with or without a port, is a name of this machine that no other machine can assign.
fn is_loopback_name(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    name.eq_ignore_ascii_case("localhost") || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// Whether two texts are equal, in a time that does not reveal where they differ.
fn is_same(one: &str, other: &str) -> bool {
    let differences = one.bytes().zip(other.bytes()).fold(0, |found, (a, b)| found | (a ^ b));
    one.len() == other.len() && differences == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(text: &str) -> Request {
        Request::parse(format!("{text}\r\n\r\n").as_bytes()).unwrap().unwrap().0
    }

    fn status(access: &Access, text: &str) -> u16 {
        access.refusal(&request(text)).map_or(200, |refusal| refusal.status)
    }

    fn access(address: &str, token: Option<&str>) -> Access {
        let listen = Listen { token: token.map(str::to_owned), ..Listen::open(address.parse().unwrap()) };
        Access::new(&listen, listen.address)
    }

    #[test]
    fn an_address_for_everyone_accepts_any_host_name_but_no_other_page() {
        let access = access("0.0.0.0:9464", None);
        assert_eq!(status(&access, "GET /metrics HTTP/1.1\r\nHost: robot.local:9464"), 200);
        assert_eq!(status(&access, "GET /metrics HTTP/1.1\r\nHost: robot\r\nOrigin: http://evil.example"), 403);
    }

    #[test]
    fn other_names_pages_and_sites_are_refused() {
        let access = access("127.0.0.1:8760", None);
        for (text, expected) in [
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:8760", 200),
            ("GET / HTTP/1.1\r\nHost: LocalHost:9000", 200),
            ("GET / HTTP/1.1\r\nHost: [::1]:8760", 200),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1.evil.example:8760", 403),
            ("GET / HTTP/1.1\r\nHost: evil.example", 403),
            ("GET / HTTP/1.1\r\nHost: 192.168.1.7:8760", 403),
            ("GET / HTTP/1.1", 400),
            ("POST /command HTTP/1.1\r\nHost: localhost:8760\r\nOrigin: http://localhost:8760", 200),
            ("POST /command HTTP/1.1\r\nHost: localhost:8760\r\nOrigin: http://evil.example", 403),
            ("POST /command HTTP/1.1\r\nHost: localhost:8760\r\nOrigin: null", 403),
            ("GET /look HTTP/1.1\r\nHost: localhost:8760\r\nSec-Fetch-Site: cross-site", 403),
            ("GET / HTTP/1.1\r\nHost: localhost:8760\r\nSec-Fetch-Site: cross-site", 200),
        ] {
            assert_eq!(status(&access, text), expected, "{text}");
        }
    }

    #[test]
    fn a_token_is_required_and_kept_as_a_cookie_or_sent_with_each_request() {
        let access = access("0.0.0.0:8760", Some("0123456789ab"));
        let host = "Host: 192.168.1.7:8760";
        assert_eq!(status(&access, &format!("GET / HTTP/1.1\r\n{host}")), 401);
        assert_eq!(status(&access, &format!("GET /?token=0123456789ac HTTP/1.1\r\n{host}")), 401);
        assert_eq!(status(&access, &format!("GET /look?token=0123456789ab HTTP/1.1\r\n{host}")), 401);
        assert_eq!(status(&access, &format!("GET /?token=0123456789ab HTTP/1.1\r\n{host}")), 303);
        let with = |cookie: &str| format!("GET /look HTTP/1.1\r\n{host}\r\nCookie: {cookie}");
        assert_eq!(status(&access, &with("a=b; conicflow_8760=0123456789ab")), 200);
        assert_eq!(status(&access, &with("conicflow_8760=0123456789abc")), 401);
        assert_eq!(status(&access, &with("conicflow_9000=0123456789ab")), 401);
        let of_program = |sent: &str| format!("GET /metrics HTTP/1.1\r\n{host}\r\nAuthorization: {sent}");
        assert_eq!(status(&access, &of_program("Bearer 0123456789ab")), 200);
        assert_eq!(status(&access, &of_program("Bearer 0123456789abc")), 401);
        assert_eq!(status(&access, &of_program("Basic 0123456789ab")), 401);
    }

    #[test]
    fn an_address_that_others_reach_comes_with_a_token() {
        let read = |address: &str| Listen::read(Some(address), None).unwrap();
        assert_eq!(read("127.0.0.1:9000").token, None);
        assert_eq!(read(":9000").address, SocketAddr::from((Ipv4Addr::LOCALHOST, 9000)));
        let open = read("0.0.0.0");
        assert_eq!((open.address.port(), open.or_any_port), (DEFAULT_PORT, false));
        assert_eq!(open.token.unwrap().len(), 32);
        assert!(Listen::read(None, None).unwrap().or_any_port);
        assert!(Listen::read(Some("0.0.0.0"), Some("short")).is_err());
        assert!(Listen::read(Some("robot.local"), None).unwrap_err().to_string().contains("hint: "));
    }
}
