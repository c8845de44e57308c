//! Machines, the edges between them, and a run's endpoints for the outside.

use super::*;

#[test]
fn where_there_are_machines_each_stage_is_on_one_of_them() {
    let of = |stage: &str| report_of(&format!("name = 'test'\n{stage}"), &[]);
    let unknown = "error: stage `printer` is on machine `robt`, which is not in the file";
    let [alone, among] = ["", MACHINES]
        .map(|machines| of(&[machines, &on("robot", CAMERA), &on("robot", DETECTOR), &on("robt", PRINTER)].concat()));
    assert_eq!(first_lines(&among), [unknown]);
    assert!(among.to_string().ends_with("hint: did you mean `robot`?"), "{among}");
    assert_eq!(first_lines(&alone).len(), 3);
    assert!(alone.to_string().ends_with("hint: add a table [machine.robt], or remove the line"), "{alone}");
    let silent = of(&[MACHINES, &on("robot", CAMERA), &on("robot", DETECTOR), PRINTER].concat());
    assert_eq!(first_lines(&silent), ["error: stage `printer` does not say on which machine it runs"]);
    assert!(silent.to_string().ends_with("machines: `base`, `robot`"), "{silent}");
}

#[test]
fn topics_cross_machines_where_writer_and_reader_are_on_different_ones() {
    let split = [MACHINES, &on("robot", CAMERA), &on("base", DETECTOR), &on("base", PRINTER)].concat();
    let read = pipeline(&split);
    assert_eq!(read.crossings(), [("depth", "robot", "base")]);
    assert!(read.is_on("camera", "robot") && !read.is_on("camera", "base") && !read.is_on("other", "robot"));
    let readers = |machine: Option<&str>| {
        let topic = read.topic_on("depth", machine);
        topic.readers.into_iter().map(|reader| (reader.stage, reader.queue)).collect::<Vec<_>>()
    };
    let [detector, bridge] = ["detector", BRIDGE].map(|stage| vec![(stage.to_owned(), 2)]);
    assert_eq!([Some("robot"), Some("base"), None].map(readers), [bridge, detector.clone(), detector]);
    let lossless = split.replace("input = 'depth'", "input = { topic = 'depth', delivery = 'lossless' }");
    assert_eq!(pipeline(&lossless).topic_on("depth", Some("robot")).delivery_to(BRIDGE), Delivery::Lossless);
    let called = |name: &str, text: &str| text.replace("stage.printer", &format!("stage.{name}"));
    assert_told(&called(BRIDGE, &split), ["error: a stage cannot be called `bridge` where edges cross machines"]);
    assert_told(&called(BRIDGE, &sound()), []);
    for (topic, is_refused) in [("/depth", true), ("depth/", true), ("a//b", true), ("a/b", false)] {
        let named = |text: &str| text.replace("'depth'", &format!("'{topic}'"));
        let fault = format!("error: the topic `{topic}` cannot cross machines: it has an empty part between slashes");
        assert_eq!(told(&named(&split)), if is_refused { vec![fault] } else { vec![] });
        assert_told(&named(&sound()), []);
        let stays = split.replace("'objects'", &format!("'{topic}'"));
        assert_told(&stays, []);
    }
}

#[test]
fn what_crosses_machines_is_of_a_kind_that_is_told_and_compressed_where_that_is_worth_it() {
    let compressed = |topic: &str| {
        sound().replace(&format!("input = '{topic}'"), &format!("input = {{ topic = '{topic}', compression = 'lz4' }}"))
    };
    assert_told(&compressed("depth"), []);
    assert_told(
        &compressed("objects"),
        ["error: `compression` is for images and ellipses, the topic `objects` carries objects"],
    );
    let (a, b) = (program("a", "output = 'things'"), program("b", "input = 'things'"));
    let fault = "error: nobody says what the topic `things` carries, and it crosses machines";
    assert_told(&[MACHINES, &on("robot", &a), &on("base", &b)].concat(), [fault]);
    let split = [MACHINES, &on("robot", CAMERA), &on("base", DETECTOR), &on("base", PRINTER)].concat();
    assert_told(&(split + &on("base", &a) + &on("base", &b)), []);
}

#[test]
fn what_another_machine_needs_of_files_need_not_be_here() {
    let (a, b) = (program("a", "output = 'things'"), program("b", "input = 'things'"));
    let missing = |stage: &str| stage.replace("['sh']", "['./missing']");
    let text = format!(
        "name = 'test'\n[machine.robot]\nkey = 'Cargo.toml'\n[machine.base]\nkey = 'missing.key'\n{}{}",
        on("robot", &a.replace("'things'", "{ topic = 'things', kind = 'objects' }")),
        on("base", &missing(&b))
    );
    let on = |machine: Option<&str>| match read_on(machine, &text, &[]) {
        Ok((_, report)) | Err(report) => first_lines(&report),
    };
    assert_eq!(on(Some("robot")), [""; 0]);
    let program = "error: there is no program `./missing`";
    for machine in [Some("base"), None] {
        let told = on(machine);
        assert!(told.len() == 2 && told[0].starts_with("error: there is no file `") && told[1] == program, "{told:?}");
    }
}

#[test]
fn a_machine_says_how_it_is_reached_and_all_have_a_key_or_none() {
    let machine = |lines: &str| format!("[machine.robot]\n{lines}\n{}", on("robot", &program("a", "")));
    let lines = "listen = ['tcp/0.0.0.0:7447']\nconnect = ['udp/base:1']\n\
                 zenoh = 'Cargo.toml'\nkey = 'Cargo.toml'\ninsecure = true\n\
                 outage_s = 2.5\nmetrics = '127.0.0.1:9464'";
    let read = pipeline(&("metrics = '127.0.0.1:1'\n".to_owned() + &machine(lines)));
    let file = Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml"));
    let listening = |text: &str| Metrics { listen: text.parse().unwrap(), token: None };
    assert_eq!(
        read.machines["robot"],
        Machine {
            listen: vec!["tcp/0.0.0.0:7447".into()],
            connect: vec!["udp/base:1".into()],
            zenoh: file.clone(),
            key: file,
            insecure: true,
            outage_s: Some(2.5),
            metrics: Some(listening("127.0.0.1:9464")),
        }
    );
    assert_eq!(read.metrics_on(Some("robot")), Some(&listening("127.0.0.1:9464")));
    assert_eq!(read.metrics_on(None), Some(&listening("127.0.0.1:1")));
    for (lines, fault) in [
        ("listen = ['tcp/robot']", "machine `robot`: `tcp/robot` is no endpoint"),
        ("insecure = 1", "`insecure` wants true or false, this is an integer"),
        ("connect = 'tcp/a:1'", "`connect` wants an array of strings, this is a string"),
        ("connect = ['tcp/a:1', 2]", "`connect` wants an array of strings, this is an integer"),
        ("outage_s = -1", "`outage_s` wants seconds, from 0 to 86400"),
        ("outage_s = 'long'", "`outage_s` wants seconds, from 0 to 86400"),
        ("lisen = []", "unknown key `lisen` in machine `robot`"),
    ] {
        assert_told(&machine(lines), [&*format!("error: {fault}")]);
    }
    let keyless = "[machine.base]\n".to_owned() + &machine("key = 'Cargo.toml'");
    assert_told(&keyless, ["error: machine `base` has no `key`, but machine `robot` has one"]);
}

#[test]
fn what_may_keep_a_machine_from_its_links_is_a_warning_there() {
    let text =
        format!("name = 'test'\n[machine.robot]\noutage_s = 0\n[machine.base]\n{}", on("robot", &program("a", "")));
    let warnings = |machine| read_on(Some(machine), &text, &[]).map(|(_, report)| first_lines(&report)).unwrap();
    let expected = vec!["warning: machine `robot`: its certificate has expired".to_owned()];
    assert_eq!([warnings("robot"), warnings("base")], [expected, vec![]], "it is that machine's concern");
}

#[test]
fn an_endpoint_has_a_protocol_a_host_and_a_port() {
    for endpoint in ["tcp/192.168.0.2:7447", "udp/[::1]:7447", "tls/host:1#iface=eth0", "quic/host:65535?x"] {
        assert!(check_endpoint(endpoint).is_ok(), "{endpoint}");
    }
    for endpoint in [
        "tcp/:7447",
        "ftp/host:1",
        "tcp/host:65536",
        "tcp/host",
        "host:1",
        "tcp/host:1:x",
        "tcp//host:1",
        "tcp/::1:7447",
    ] {
        assert_eq!(check_endpoint(endpoint).unwrap_err().what, format!("`{endpoint}` is no endpoint"));
    }
    assert!(check_endpoint("tcp/fe80::1:7447").unwrap_err().hint.contains("brackets"));
}

#[test]
fn a_host_without_an_address_is_told() {
    for endpoint in ["tcp/localhost:7447", "tcp/127.0.0.1:7447", "udp/[::1]:7447#iface=lo"] {
        assert_eq!(check_host(endpoint), Ok(()), "{endpoint}");
    }
    let told = check_host("tcp/no-such-host.invalid:7447").unwrap_err();
    assert!(told.what.starts_with("the host of `tcp/no-such-host.invalid:7447` is not known here: "), "{told}");
}

#[test]
fn who_offers_metrics_to_everyone_is_warned() {
    let metrics = |said: &str| format!("metrics = {said}\n{}", sound());
    let read = pipeline(&metrics("{ listen = '0.0.0.0:9464', token = 'secret' }")).metrics.unwrap();
    assert_eq!((read.listen.port(), read.token.as_deref()), (9464, Some("secret")));
    let open = "warning: everyone who reaches 0.0.0.0:9464 may read the metrics";
    for (said, expected) in [
        ("'0.0.0.0:9464'", vec![open]),
        ("{ listen = '0.0.0.0:9464' }", vec![open]),
        ("{ listen = '0.0.0.0:9464', token = 'secret' }", vec![]),
        ("'127.0.0.1:9464'", vec![]),
        ("{ token = 'secret' }", vec!["error: `metrics` has no `listen`"]),
        ("'here'", vec!["error: `metrics` cannot be `here`, expected ADDRESS:PORT in numbers"]),
        ("{ listen = '[::1]:1', tokn = 'a' }", vec!["error: unknown key `tokn` in `metrics`"]),
    ] {
        assert_eq!(told(&metrics(said)), expected, "{said}");
    }
    let text = format!(
        "name = 'test'\n[machine.robot]\n[machine.base]\nmetrics = '0.0.0.0:9464'\n{}",
        on("robot", &program("a", ""))
    );
    let warnings = |machine| read_on(Some(machine), &text, &[]).map(|(_, report)| first_lines(&report)).unwrap();
    assert_eq!([warnings("robot"), warnings("base")], [vec![], vec![open.to_owned()]], "it is that machine's concern");
}
