//! Cameras with an SDK of their maker that comes as a Python package: RealSense, Orbbec, OAK-D, Azure Kinect.
//!
//! This file has their parameters, chooses the Python that runs them, and checks that it has the packages. The sources themselves
//! are `conicflow.cameras` in `python/`.

use crate::faults::one_of_two;
use conicflow_dataflow::{
    ConfigFault, Context, FileUse, Hinted, Host, Next, Output, SideInputs, Source, StageError, Variables,
};
use conicflow_detection::noise::NoiseConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::convert::Infallible;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Parameters of a camera over the SDK of its maker.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Serial number of the camera; default: the first that is found.
    pub serial: Option<String>,
    /// A recording of the SDK, played back in place of a camera.
    pub path: Option<PathBuf>,
    /// Columns of the depth images; default: as the camera chooses.
    #[schemars(range(min = 1, max = 16384))]
    pub width: Option<u32>,
    /// Rows of the depth images; default: as the camera chooses.
    #[schemars(range(min = 1, max = 16384))]
    pub height: Option<u32>,
    /// Images per second that are asked of the camera; default: as it chooses.
    #[schemars(range(min = 1, max = 1000))]
    pub fps: Option<u32>,
    /// Depth noise of the sensor: a name (`kinect_v1`, `realsense_d435`, `time_of_flight`, `ideal`) or a table; default: by the
    /// base line and focal length of a stereo camera as the SDK reports them, or by the kind of camera.
    pub noise: Option<NoiseConfig>,
    /// After so many seconds without an image the camera is opened anew.
    #[schemars(range(min = 0.1, max = 3600.0))]
    pub stall_s: f64,
    /// The Python that has the SDK and the package conicflow: a program in PATH or a path; default: that of the virtual
    /// environment (VIRTUAL_ENV), else `python3`.
    pub python: Option<PathBuf>,
}

impl Default for Config {
    fn default() -> Self {
        Self { serial: None, path: None, width: None, height: None, fps: None, noise: None, stall_s: 3.0, python: None }
    }
}

/// Folder in which the Debian package installs the Python package; only the distribution's own Python finds it.
const OF_DEBIAN: &str = "/usr/lib/python3/dist-packages/conicflow";

/// A maker of cameras.
pub trait Maker {
    /// The node's name.
    const NODE: &'static str;
    /// Name of the adapter in `conicflow.cameras`, and of the extra of the package conicflow that installs the SDK.
    const ADAPTER: &'static str;
    /// The package with the SDK.
    const SDK: &'static str;
    /// One sentence about the node, and with which cameras it was tried.
    const SUMMARY: &'static str;
    /// Whether the SDK plays back recordings without a camera.
    const PLAYS_BACK: bool = true;
}

/// Intel RealSense.
pub struct RealSense;

impl Maker for RealSense {
    const NODE: &'static str = "realsense_source";
    const ADAPTER: &'static str = "realsense";
    const SDK: &'static str = "pyrealsense2";
    const SUMMARY: &'static str = "Takes depth images from an Intel RealSense by its SDK (pip install pyrealsense2); tried \
                                   with the SDK's software device and recordings, not with a camera";
}

/// Orbbec Femto, Gemini, Astra 2.
pub struct Orbbec;

impl Maker for Orbbec {
    const NODE: &'static str = "orbbec_source";
    const ADAPTER: &'static str = "orbbec";
    const SDK: &'static str = "pyorbbecsdk2";
    const SUMMARY: &'static str = "Takes depth images from an Orbbec camera by its SDK (pip install pyorbbecsdk2); tried with \
                                   stand-ins for the SDK's classes, not with a camera";
}

/// Luxonis OAK-D.
pub struct OakD;

impl Maker for OakD {
    const NODE: &'static str = "oakd_source";
    const ADAPTER: &'static str = "oakd";
    const SDK: &'static str = "depthai";
    const SUMMARY: &'static str = "Takes depth images from a Luxonis OAK-D by its SDK (pip install depthai); tried with \
                                   stand-ins for the SDK's classes, not with a camera";
    const PLAYS_BACK: bool = false;
}

/// Microsoft Azure Kinect.
pub struct AzureKinect;

impl Maker for AzureKinect {
    const NODE: &'static str = "azure_kinect_source";
    const ADAPTER: &'static str = "azure_kinect";
    const SDK: &'static str = "pyk4a";
    const SUMMARY: &'static str = "Takes depth images from an Azure Kinect by its SDK (libk4a and pip install pyk4a), and \
                                   rectifies them; tried with stand-ins for the SDK's classes, not with a camera";
}

/// The node of a camera; this program has only its parameters, as Python runs it.
pub struct SdkCamera<M>(Infallible, PhantomData<M>);

impl<M: Maker> Source for SdkCamera<M> {
    const NAME: &'static str = M::NODE;
    const SUMMARY: &'static str = M::SUMMARY;
    type Config = Config;
    type Output = u16;

    fn faults(config: &Config, base: &Path) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        let path = config.path.as_ref().map(|path| base.join(path));
        if path.is_some() && !M::PLAYS_BACK {
            let what = "its SDK plays nothing back without a camera";
            faults.push(ConfigFault::new("path", what, "record with `mcap_sink`, and play back with `mcap_source`"));
        } else if let Some(path) = path {
            faults.extend(ConfigFault::of_missing("path", &path));
        }
        faults.extend(one_of_two(config.width, config.height));
        faults
    }

    fn reads(config: &Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("path", &config.path)])
    }

    fn new(_: Config, _: &Context) -> Result<Self, StageError> {
        Err(Hinted::new(format!("`{}` runs in Python", M::NODE), "start it by `conicflow run`").into())
    }

    fn message_length(config: &Config, _: &Path) -> Option<usize> {
        Some(config.width? as usize * config.height? as usize)
    }

    fn next(&mut self, _: &SideInputs, _: &mut Output<u16>) -> Result<Next, StageError> {
        match self.0 {}
    }
}

impl<M: Maker> SdkCamera<M> {
    /// The Python program that runs the node.
    pub const HOST: Host = Host { command: command::<M>, check: check::<M> };
}

fn command<M: Maker>(parameters: &Json, base: &Path) -> Result<Vec<String>, Hinted> {
    Ok(vec![python(parameters, base), "-m".to_owned(), "conicflow.cameras".to_owned(), M::ADAPTER.to_owned()])
}

/// Returns the Python that the parameters name, or that of the virtual environment, or the first in PATH.
fn python(parameters: &Json, base: &Path) -> String {
    let environment = || std::env::var_os("VIRTUAL_ENV").map(|folder| Path::new(&folder).join("bin/python"));
    let python = match parameters.get("python").and_then(Json::as_str) {
        Some(program) if program.contains('/') => Some(base.join(program)),
        Some(program) => Some(program.into()),
        None => environment().filter(|python| python.is_file()),
    };
    python.unwrap_or_else(|| "python3".into()).to_string_lossy().into_owned()
}

/// Checks, by importing them in that Python, that it has the packages that the camera needs.
fn check<M: Maker>(parameters: &Json, base: &Path, env: &Variables) -> Result<(), Hinted> {
    let python = python(parameters, base);
    let mut command = Command::new(&python);
    command.args(["-m", "conicflow.cameras", M::ADAPTER, "--check"]).current_dir(base).stdin(Stdio::null());
    command.envs(env.iter().map(|(key, value)| (key, value)));
    let on_debian = Path::new(OF_DEBIAN).exists();
    let output = command.output().map_err(|error| {
        let otherwise = || "install Python 3, or name one: `python = \"/path/to/python3\"`".to_owned();
        let hint = if on_debian { how_to_install::<M>(&python, on_debian) } else { otherwise() };
        Hinted::new(format!("there is no Python to run it (`{python}`: {error})"), hint)
    })?;
    if output.status.success() {
        return Ok(());
    }
    // A report about the SDK comes as JSON; any other output means that the package conicflow is missing.
    Err(serde_json::from_slice(&output.stdout).unwrap_or_else(|_| {
        let stderr = String::from_utf8_lossy(&output.stderr);
        let last = stderr.trim_end().lines().last().unwrap_or("it says nothing").to_owned();
        let hint = how_to_install::<M>(&python, on_debian);
        Hinted::new(format!("`{python}` cannot import conicflow.cameras ({last})"), hint)
    }))
}

/// Returns the hint how to install the package conicflow and the SDK: from the sources, or with the Debian package.
fn how_to_install<M: Maker>(python: &str, on_debian: bool) -> String {
    if !on_debian {
        let install = format!("{python} -m pip install \"./python[{}]\"", M::ADAPTER);
        return format!(
            "in the folder of conicflow: `{install}`; or name a Python that has it: `python = \"venv/bin/python\"`"
        );
    }
    let venv = "sudo /usr/bin/python3 -m venv --system-site-packages /opt/conicflow";
    let install = format!("sudo /opt/conicflow/bin/pip install {}", M::SDK);
    format!(
        "`sudo apt install python3-numpy python3-venv && {venv} && {install}`, and in the table of the stage `python = \
         \"/opt/conicflow/bin/python\"`"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::pipeline::{Pipeline, SourceText};
    use conicflow_dataflow::{NO_RUN, Plan};
    use serde_json::json;
    use std::process::Command;

    /// Runs the check with a shell script in place of Python.
    fn check_with(script: &str) -> Result<(), Hinted> {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("python");
        // Written by another process: a program cannot be executed while a child of another test still has it open for writing.
        let mut shell = Command::new("sh");
        shell.args(["-c", "printf '#!/bin/sh\\n%s\\n' \"$1\" > \"$0\" && chmod 755 \"$0\""]).arg(&program).arg(script);
        assert!(shell.status().unwrap().success());
        let env = [("SDK".to_owned(), "there".to_owned())];
        check::<RealSense>(&json!({"python": "./python"}), folder.path(), &env)
    }

    #[test]
    fn the_check_by_python_returns_its_answer() {
        assert_eq!(check_with("test \"$*\" = '-m conicflow.cameras realsense --check' && test $SDK = there"), Ok(()));
        let answer = r#"echo '{"what": "no SDK", "hint": "install it"}'; exit 2"#;
        assert_eq!(check_with(answer), Err(Hinted::new("no SDK", "install it")));
        let silent = check_with("echo noise; echo 'No module named conicflow' >&2; exit 1").unwrap_err();
        assert!(silent.what.ends_with("cannot import conicflow.cameras (No module named conicflow)"), "{silent}");
        assert!(silent.hint.contains("/./python -m pip install \"./python[realsense]\"`"), "{silent}");
        let on_debian = how_to_install::<RealSense>("python3", true);
        assert!(
            on_debian
                .contains("--system-site-packages /opt/conicflow && sudo /opt/conicflow/bin/pip install pyrealsense2`")
        );
        let none = check::<OakD>(&json!({"python": "no/python"}), Path::new("/nowhere"), &[]).unwrap_err();
        assert!(none.what.starts_with("there is no Python to run it (`/nowhere/no/python`: "), "{none}");
    }

    #[test]
    fn the_parameters_name_the_python() {
        let base = Path::new("/robot");
        assert_eq!(python(&json!({"python": "venv/bin/python"}), base), "/robot/venv/bin/python");
        assert_eq!(python(&json!({"python": "python3.13"}), base), "python3.13");
        let command = (SdkCamera::<Orbbec>::HOST.command)(&json!({"python": "python3"}), base).unwrap();
        assert_eq!(command, ["python3", "-m", "conicflow.cameras", "orbbec"]);
    }

    #[test]
    fn faults_are_reported() {
        fn faults<M: Maker>(config: &Config) -> Vec<String> {
            let faults = SdkCamera::<M>::faults(config, Path::new("/nowhere"));
            faults.into_iter().map(|fault| format!("{}: {}", fault.key, fault.what)).collect()
        }
        assert!(faults::<OakD>(&Config::default()).is_empty());
        let wrong = Config { path: Some("a.mkv".into()), height: Some(576), ..Config::default() };
        assert_eq!(faults::<AzureKinect>(&wrong), ["path: `/nowhere/a.mkv` does not exist", "height: is one of two"]);
        let reported = faults::<OakD>(&Config { path: Some("a".into()), ..Config::default() });
        assert_eq!(reported, ["path: its SDK plays nothing back without a camera"]);
    }

    #[test]
    fn python_gets_its_parameters_with_all_defaults() {
        let camera =
            "node = \"realsense_source\"\noutput = \"depth\"\npython = \"true\"\nfps = 15\nnoise = \"ideal\"\n";
        let text = format!("name = \"a\"\n[stage.camera]\n{camera}");
        let source = SourceText { name: "a.toml".to_owned(), text };
        let (pipeline, _) = Pipeline::read_on(None, source, Path::new("."), &[], &crate::REGISTRY).unwrap();
        let plan = Plan::of(&pipeline, None, None, NO_RUN);
        let expected = json!({
            "serial": null, "path": null, "width": null, "height": null, "fps": 15, "noise": "ideal", "stall_s": 3.0,
            "python": "true",
        });
        assert_eq!(plan.stage("camera").unwrap().parameters, expected);
    }
}
