//! Tests of the program that `conicflow` starts from its own folder. (It is built with this test, so that it exists where the
//! tests of the whole workspace are built.)

#![allow(clippy::unwrap_used)] // in tests, a panic is a failure

use std::io::Write as _;
use std::process::{Command, Output, Stdio};

fn ask(question: &[&str], machine: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_conicflow-bridge"));
    command.args(question).env_remove("CONICFLOW_PIPELINE");
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(machine.as_bytes()).unwrap();
    child.wait_with_output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn the_program_answers_questions_about_a_machine() {
    let local =
        r#"{"listen": ["tcp/127.0.0.1:7447"], "connect": [], "zenoh": null, "insecure": false, "outage_s": null}"#;
    assert_eq!(text(&ask(&["check"], local).stdout), "{\"Ok\":null}\n");
    assert_eq!(text(&ask(&["endpoints"], local).stdout), "{\"Ok\":[\"tcp/127.0.0.1:7447\"]}\n");
    assert_eq!(text(&ask(&["warnings"], local).stdout), "[]\n");
    let open = local.replace("127.0.0.1", "0.0.0.0");
    let refused = ask(&["check"], &open);
    assert!(text(&refused.stdout).starts_with("{\"Err\":{\"what\":"), "{}", text(&refused.stdout));
}

#[test]
fn a_user_who_starts_the_program_by_hand_reads_what_it_is_for() {
    for arguments in [&[][..], &["carry"]] {
        let ended = ask(arguments, "");
        assert_eq!(ended.status.code(), Some(2), "{arguments:?}");
        assert!(text(&ended.stderr).contains("\n  hint: "), "{}", text(&ended.stderr));
    }
}
