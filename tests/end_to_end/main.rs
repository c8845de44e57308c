//! The program as its users have it: the real binary, started as a process, on files in folders of its own.

#![allow(missing_docs)] // a test's name says what it shows
#![allow(clippy::unwrap_used, clippy::panic)] // what a test cannot go on from is its failure

mod bridge;
mod certificates;
mod commands;
mod detect;
#[cfg(target_os = "linux")]
mod doctor;
mod experiments;
#[cfg(target_os = "linux")]
mod faults;
#[cfg(target_os = "linux")]
mod full_memory;
mod hostile_files;
#[cfg(target_os = "linux")]
mod hosts;
#[cfg(target_os = "linux")]
mod identities;
#[cfg(target_os = "linux")]
mod intruders;
mod node;
mod outside_stage;
#[cfg(target_os = "linux")]
mod own_memory;
mod own_types;
#[cfg(target_os = "linux")]
mod processes;
#[cfg(target_os = "linux")]
mod radio;
#[cfg(target_os = "linux")]
mod recordings;
#[cfg(target_os = "linux")]
mod room;
mod routers;
mod run;
mod several_machines;
#[cfg(target_os = "linux")]
mod soak;
#[cfg(target_os = "linux")]
mod stress;
mod support;
#[cfg(target_os = "linux")]
mod swap;
#[cfg(target_os = "linux")]
mod swap_joined;
#[cfg(target_os = "linux")]
mod three_hosts;
#[cfg(target_os = "linux")]
mod top;
mod topic;
mod validate;
