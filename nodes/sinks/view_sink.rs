//! Shows its input on a page for the browser, like `conicflow view`, but as a part of the run.
//!
//! A step costs a copy of the frame while a browser is connected, and nothing else; the page is served by threads of low
//! priority.

use crate::viewing::graph::GraphWatch;
use crate::viewing::{list_of, pausing};
use conicflow_dataflow::{
    AnyMessage, ConfigFault, Context, ItemType, Output, SideInput, SideInputs, Stage, StageError, monotonic_ns,
};
use conicflow_messages::{Hinted, Item, Message, Nothing};
use conicflow_view::{Depth, Display, Frame, Listen, ListenFault, Page, Server, lower_priority};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::marker::PhantomData;
use std::path::Path;
use std::sync::{Arc, Weak};
use std::thread;
use std::time::{Duration, Instant};

/// Period of the graph's updates.
const PERIOD: Duration = Duration::from_secs(1);
/// Period of the checks whether the sink has ended.
const END_CHECK_PERIOD: Duration = Duration::from_millis(250);

/// Parameters of `view_sink`.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ViewSinkConfig {
    /// Address of the page, as ADDRESS or ADDRESS:PORT; default: 127.0.0.1:8760, or another port where that is taken.
    pub listen: Option<String>,
    /// Token that is needed to see the page; default: none at 127.0.0.1; where other machines may come, one is made and logged.
    pub token: Option<String>,
}

impl ViewSinkConfig {
    fn read(&self) -> Result<Listen, ListenFault> {
        Listen::read(self.listen.as_deref(), self.token.as_deref())
    }
}

/// Shows each message, with the depth image of the same frame.
pub struct ViewSink<T> {
    display: Arc<Display>,
    _server: Server,
    item: PhantomData<T>,
}

impl<T: Item> Stage for ViewSink<T> {
    const NAME: &'static str = "view_sink";
    const SUMMARY: &'static str = "Shows depth images and what was found in them on a page for the browser";
    type Config = ViewSinkConfig;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, _: &Path) -> Vec<ConfigFault> {
        match config.read() {
            Err(ListenFault::Text(Hinted { what, hint, .. })) => {
                let key = if what.contains("token") { "token" } else { "listen" };
                vec![ConfigFault { key, what, hint }]
            }
            Err(ListenFault::Token(_)) | Ok(_) => Vec::new(),
        }
    }

    fn new(config: ViewSinkConfig, context: &Context) -> Result<Self, StageError> {
        let display = Arc::new(Display::default());
        let server = Server::start(&config.read()?, Page::new(Arc::clone(&display)))?;
        tracing::info!("{}: open {} in a browser", context.stage, server.url());
        let shown = Arc::downgrade(&display);
        thread::Builder::new().name("graph".to_owned()).spawn(move || show_graph(&shown))?;
        Ok(Self { display, _server: server, item: PhantomData })
    }

    fn side_inputs() -> &'static [SideInput] {
        const { &[SideInput::same_frame::<u16>("depth")] }
    }

    fn step(&mut self, input: &Message<T>, sides: &SideInputs, output: &mut Output<Nothing>) -> Result<(), StageError> {
        if !self.display.is_watched() {
            return Ok(());
        }
        let (header, bytes) = (*input.header, bytemuck::cast_slice(input.items));
        let message = AnyMessage { header: &header, item: const { &ItemType::of::<T>() }, bytes };
        let depth = message.typed::<u16>().or_else(|| sides.get::<u16>("depth"));
        let depth = depth.map(|depth| Arc::new(Depth { header: *depth.header, pixels: depth.items.to_vec() }));
        let latency_ms = header.latency_ms(monotonic_ns());
        let list = list_of(&message).unwrap_or_default();
        self.display.show(Frame { header, depth, list, compared: None, latency_ms });
        output.count("frames shown", 1);
        Ok(())
    }
}

/// Shows the state of the run's stages on the page once a second while a browser is connected, and pauses the run on request.
fn show_graph(shown: &Weak<Display>) {
    lower_priority();
    let (mut watch, mut pipeline, mut last_check) = (GraphWatch::default(), None::<String>, Instant::now());
    while let Some(display) = shown.upgrade() {
        if let Some((command, pipeline)) = display.next_command(END_CHECK_PERIOD).zip(pipeline.as_ref()) {
            pausing::obey(pipeline, &command, &display);
        }
        if last_check.elapsed() < PERIOD {
            continue;
        }
        last_check = Instant::now();
        if display.is_watched() {
            let own = std::process::id();
            if let Some((graph, sources)) =
                watch.observe_graph(|seen| seen.stages.iter().any(|stage| stage.process == own))
            {
                let name = graph["activity"]["pipeline"].as_str().unwrap_or_default().to_owned();
                pipeline = Some(name.clone());
                display.change_about(|about| (about.title, about.graph) = (name, graph));
                pausing::show_run(sources, &display);
            }
        } else {
            watch.rest();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Track;

    #[test]
    fn an_invalid_address_is_reported_before_the_start() {
        let fault = |listen: &str, token: Option<&str>| {
            let config = ViewSinkConfig { listen: Some(listen.to_owned()), token: token.map(str::to_owned) };
            ViewSink::<Track>::faults(&config, Path::new("")).first().map(|fault| fault.key)
        };
        assert_eq!(fault("127.0.0.1:9000", None), None);
        assert_eq!(fault("robot.local", None), Some("listen"));
        assert_eq!(fault("0.0.0.0", Some("short")), Some("token"));
    }
}
