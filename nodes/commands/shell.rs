//! `conicflow completions` and `conicflow man`: shell completions and manual pages, made from the commands themselves.

use clap::Command;
use clap_complete::{Shell, generate};
use clap_mangen::Man;
use std::io::{Write, stdout};

const NAME: &str = "conicflow";

/// Writes the script with which a shell completes commands and their arguments.
///
/// # Errors
/// Standard output cannot be written.
pub fn completions(shell: Shell, command: &mut Command) -> anyhow::Result<()> {
    let mut script = Vec::new();
    generate(shell, command, NAME, &mut script);
    Ok(stdout().write_all(&script)?)
}

/// Writes the manual page of the program and those of all commands, one after the other.
///
/// # Errors
/// Standard output cannot be written.
pub fn manual(mut command: Command) -> anyhow::Result<()> {
    command.build();
    let mut pages = Vec::new();
    push_pages(&command, &mut pages)?;
    Ok(stdout().write_all(&pages)?)
}

fn push_pages(command: &Command, pages: &mut Vec<u8>) -> anyhow::Result<()> {
    Man::new(command.clone()).render(pages)?;
    let mut inner = command.get_subcommands().filter(|inner| inner.get_name() != "help" && !inner.is_hide_set());
    inner.try_for_each(|inner| push_pages(inner, pages))
}
