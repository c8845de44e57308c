//! Tests of the real program, which is started as a process in folders of each test's own.

#![allow(missing_docs)] // a test's name says what it shows
#![allow(clippy::unwrap_used, clippy::panic)] // what a test cannot go on from is its failure

mod as_the_readme_says;
mod attack;
mod bridge;
mod browser;
mod certificates;
mod commands;
mod compare;
mod crash_points;
mod detect;
mod doctor;
mod experiments;
mod faults;
mod full_disk;
mod full_memory;
mod hostile_files;
mod hosts;
mod identities;
mod intruders;
mod kept;
#[path = "../../bridge/src/loopback.rs"]
mod loopback;
mod metrics;
mod node;
mod outside_stage;
mod overwriting;
mod own_memory;
mod own_types;
mod pause;
mod processes;
mod programs;
mod radio;
mod recordings;
mod room;
mod ros2;
mod routers;
mod run;
mod several_machines;
mod soak;
mod stress;
mod support;
mod swap;
mod swap_joined;
mod three_hosts;
mod top;
mod topic;
mod validate;
mod view;
mod webdriver;
