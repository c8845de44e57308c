//! What the browsers that show the page are answered.
//!
//! A browser asks for what it has not seen yet (`/look`), and gets it as soon as it is there; when it has drawn it, it asks anew.
//! So a slow browser leaves frames out, and a browser that is gone asks for none.

use crate::display::Display;
use crate::page::file;
use crate::request::Request;
use crate::response::Response;
use crate::server::Answer;
use serde_json::json;
use std::sync::Arc;
use std::time::Duration;

/// A request that nothing new comes for is answered after this time.
const UPDATE_TIMEOUT: Duration = Duration::from_millis(1000);
/// How long the name is that a browser gives itself, at most.
const LONGEST_NAME: usize = 40;
/// What is sent to a browser begins with a text, whose length is a multiple of this.
const ALIGNMENT: usize = 4;

/// The page, with what a display shows.
pub struct Page {
    display: Arc<Display>,
}

impl Answer for Page {
    fn answer(&self, request: &Request) -> Response {
        match (request.method.as_str(), request.path.as_str()) {
            ("GET", "/look") => self.look(request),
            ("POST", "/command") => self.command(request),
            ("GET", path) => match file(path) {
                Some((kind, content)) => Response::file(kind, content),
                None => Response::refusal(404, "there is nothing here; the page is at /"),
            },
            _ => Response::refusal(405, "this is not done here"),
        }
    }
}

impl Page {
    /// The page that shows a display.
    pub fn new(display: Arc<Display>) -> Self {
        Self { display }
    }

    /// What a browser has not seen: the length of a text in four bytes, the text in JSON, the depths of the pixels.
    fn look(&self, request: &Request) -> Response {
        let browser = request.query("browser").unwrap_or_default();
        if browser.is_empty() || browser.len() > LONGEST_NAME {
            return Response::refusal(400, "a browser gives itself a name of up to 40 letters");
        }
        let look = self.display.look(browser, request.number("frames"), request.number("told"), UPDATE_TIMEOUT);
        let look = match look {
            Ok(look) => look,
            Err(too_many) => {
                return Response::busy(&format!("{} browsers look already: close one of them", too_many.limit));
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
        if !request.header("content-type").is_some_and(is_json) {
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

/// Whether a `Content-Type` is that of JSON, with or without parameters such as its character set.
fn is_json(kind: &str) -> bool {
    kind.split(';').next().is_some_and(|kind| kind.trim().eq_ignore_ascii_case("application/json"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wish_in_json_may_name_its_character_set() {
        let page = Page::new(Arc::default());
        let status = |kind: &str| {
            let head = format!("POST /command HTTP/1.1\r\nContent-Type: {kind}\r\n\r\n");
            let (mut request, _) = Request::parse(head.as_bytes()).unwrap().unwrap();
            request.body = br#"{"do":"pause"}"#.to_vec();
            page.answer(&request).status
        };
        for kind in ["application/json", "application/json; charset=utf-8", "Application/JSON;charset=UTF-8"] {
            assert_eq!(status(kind), 204, "{kind}");
        }
        for kind in ["text/plain", "application/jsonp", "text/plain; application/json", ""] {
            assert_eq!(status(kind), 415, "{kind}");
        }
    }
}
