//! Answers the requests of browsers that show the page.
//!
//! A browser asks for news (`/look`), and gets them as soon as there are any; once it has drawn them, it asks again. So a slow
//! browser skips frames, and a closed one gets none.

use crate::display::Display;
use crate::page::file;
use crate::request::Request;
use crate::response::Response;
use crate::server::Answer;
use serde_json::json;
use std::sync::Arc;
use std::time::Duration;

/// A request is answered after this time even if there is no news.
const UPDATE_TIMEOUT: Duration = Duration::from_millis(1000);
/// Maximum length of the name that a browser gives itself.
const LONGEST_NAME: usize = 40;
/// The text at the start of an answer is padded to a multiple of this length.
const ALIGNMENT: usize = 4;

/// The page for a display.
pub struct Page {
    display: Arc<Display>,
}

impl Answer for Page {
    fn answer(&self, request: &Request) -> Response {
        match (request.method.as_str(), request.path.as_str()) {
            ("GET", "/look") => self.update(request),
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
    /// Creates the page for a display.
    pub fn new(display: Arc<Display>) -> Self {
        Self { display }
    }

    /// The answer with the news for a browser: the length of a text in four bytes, the text in JSON, the depths of the pixels.
    fn update(&self, request: &Request) -> Response {
        let browser = request.query("browser").unwrap_or_default();
        if browser.is_empty() || browser.len() > LONGEST_NAME {
            return Response::refusal(400, "a browser gives itself a name of up to 40 letters");
        }
        let update =
            self.display.wait_for_update(browser, request.number("frames"), request.number("told"), UPDATE_TIMEOUT);
        let update = match update {
            Ok(update) => update,
            Err(too_many) => {
                return Response::busy(&format!("{} browsers look already: close one of them", too_many.limit));
            }
        };
        let columns = u32::try_from(request.number("columns")).unwrap_or(u32::MAX);
        let step = update.frame.as_ref().map_or(1, |frame| frame.step(columns));
        let json = json!({
            "frames": update.frames,
            "frame": update.frame.as_ref().map(|frame| frame.to_json(step)),
            "told": update.changes,
            "about": update.about.as_deref(),
            "player": update.player,
        });
        let mut text = json.to_string();
        text.extend(std::iter::repeat_n(' ', text.len().next_multiple_of(ALIGNMENT) - text.len()));
        // No text is longer: a list has a few hundred items of some kilobytes each.
        let mut bytes = u32::try_from(text.len()).unwrap_or(0).to_le_bytes().to_vec();
        bytes.extend(text.as_bytes());
        if let Some(frame) = &update.frame {
            frame.write_pixels(step, &mut bytes);
        }
        Response::new(200, "application/octet-stream", bytes)
    }

    fn command(&self, request: &Request) -> Response {
        if !request.header("content-type").is_some_and(is_json) {
            return Response::refusal(415, "a command is sent as JSON");
        }
        match serde_json::from_slice(&request.body) {
            Ok(command) => {
                self.display.queue_command(command);
                Response::new(204, "text/plain; charset=utf-8", Vec::new())
            }
            Err(error) => Response::refusal(400, &format!("no wish that is known: {error}")),
        }
    }
}

/// Whether a `Content-Type` is JSON, with or without parameters such as the character set.
fn is_json(kind: &str) -> bool {
    kind.split(';').next().is_some_and(|kind| kind.trim().eq_ignore_ascii_case("application/json"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_in_json_may_name_its_character_set() {
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
