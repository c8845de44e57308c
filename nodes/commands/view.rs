//! `conicflow view`: a page for the browser that shows running pipelines, or a recording.

use crate::viewing::live::Live;
use crate::viewing::player::Player;
use anyhow::{Result, bail};
use clap::Args;
use conicflow_dataflow::termination_flag;
use conicflow_messages::Hinted;
use conicflow_view::{Display, Listen, Page, Server, lower_priority};
use std::io::{Write, stdout};
use std::path::PathBuf;
use std::sync::Arc;

/// The recording or pipeline to show, and the address of the page.
#[derive(Args)]
pub struct ViewArguments {
    /// A recording: an MCAP file, or a folder of them [default: running pipelines]
    file: Option<PathBuf>,
    /// A second recording of the same frames, such as `compare --record` writes: what both have found, and what only one has
    against: Option<PathBuf>,
    /// Address of the page; one that other machines reach asks for a token [default: 127.0.0.1:8760, else another port]
    #[arg(long, value_name = "ADDRESS[:PORT]")]
    listen: Option<String>,
    /// Token that is needed to see the page [default: one is made and printed where other machines may reach the page]
    #[arg(long, value_name = "TEXT")]
    token: Option<String>,
    /// Name of the pipeline, where several run; another one can be chosen on the page
    #[arg(long, value_name = "NAME", conflicts_with = "file")]
    pipeline: Option<String>,
    /// The recording's topic with depth images, where it has several
    #[arg(long, value_name = "TOPIC", requires = "file")]
    topic: Option<String>,
}

/// Serves the page until a signal ends this program.
///
/// # Errors
/// The address cannot be used, or there is no such recording.
pub fn view(arguments: &ViewArguments) -> Result<()> {
    lower_priority();
    let terminated = termination_flag()?;
    let display = Arc::new(Display::default());
    let listen = Listen::read(arguments.listen.as_deref(), arguments.token.as_deref())?;
    if let Some(file) = &arguments.file {
        let missing = [Some(file), arguments.against.as_ref()].into_iter().flatten().find(|file| !file.exists());
        if let Some(missing) = missing {
            let what = format!("there is no recording `{}`", missing.display());
            bail!(Hinted::new(what, "name an MCAP file, or a folder of them; without one the page shows what runs"));
        }
        let mut player =
            Player::open(file, arguments.topic.as_deref(), arguments.against.as_deref(), Arc::clone(&display))?;
        let _server = offer(&listen, display)?;
        player.play(&terminated);
        return Ok(());
    }
    let live = Live::start(Arc::clone(&display), arguments.pipeline.clone())?;
    let _server = offer(&listen, display)?;
    live.show(&terminated)
}

/// Serves the page, and prints its address.
fn offer(listen: &Listen, display: Arc<Display>) -> Result<Server> {
    let server = Server::start(listen, Page::new(display))?;
    writeln!(stdout(), "{}", server.url())?;
    stdout().flush()?;
    tracing::info!("open this address in a browser; Ctrl-C ends it");
    Ok(server)
}
