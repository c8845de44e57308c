//! `conicflow completions` and `conicflow man`: what a shell and `man` know of the commands, made from the commands themselves.

use clap::Command;
use clap_complete::{Shell, generate};
use clap_mangen::Man;
use std::io::{Write, stdout};

const NAME: &str = "conicflow";

/// Writes what a shell completes commands and their arguments by.
///
/// # Errors
/// Standard output cannot be written.
pub fn completions(shell: Shell, command: &mut Command) -> anyhow::Result<()> {
    let mut script = Vec::new();
    generate(shell, command, NAME, &mut script);
    Ok(stdout().write_all(&script)?)
}

/// Writes a manual page of the program and one of each command, one behind the other, as `man` shows them.
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
