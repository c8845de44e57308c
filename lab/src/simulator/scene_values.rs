//! Scene files with variable values: `[values]` has their defaults, `"$distance"` in place of a number uses one, and a pipeline
//! file or an experiment sets others. The frames' source has the values, so that the truth follows from it and the file.

use super::scene::Scene;
use super::scene_file;
use anyhow::{Result, bail, ensure};
use conicflow_messages::{Hinted, MAX_SOURCE_BYTES};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Values by name.
pub type Values = BTreeMap<String, f64>;

/// A scene file with variable values.
#[derive(Clone, Debug)]
pub struct SceneTemplate {
    text: String,
    origin: String,
    defaults: Values,
}

/// The part of a scene file that is read before its values are substituted.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Head {
    name: String,
    values: Values,
}

impl SceneTemplate {
    /// Reads a scene file; its text is only checked when a scene is made of it.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn load(path: &Path) -> Result<Self> {
        Ok(Self::new(scene_file::read(path)?, path.display().to_string()))
    }

    /// Creates a template from a scene file's text; `origin` is its name in errors.
    pub fn new(text: String, origin: String) -> Self {
        let defaults = head(&text).values;
        Self { text, origin, defaults }
    }

    /// Returns the scene with these values, and the defaults for the others.
    ///
    /// # Errors
    /// A value is not in the file, the scene's name with the values does not fit into a frame's header, or the scene is not
    /// valid.
    pub fn scene(&self, set: &Values) -> Result<Scene> {
        if let Some(unknown) = set.keys().find(|name| !self.defaults.contains_key(*name)) {
            let names: Vec<_> = self.defaults.keys().map(String::as_str).collect();
            let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            let hint = format!("values under `[values]`: {names}");
            bail!(Hinted::new(format!("{}: the scene has no value `{unknown}`", self.origin), hint));
        }
        let values: Values =
            self.defaults.iter().map(|(name, value)| (name.clone(), *set.get(name).unwrap_or(value))).collect();
        let text = values.iter().fold(self.text.clone(), |text, (name, value)| {
            text.replace(&format!("\"${name}\""), &format!("{value:?}"))
        });
        let mut scene = Scene::parse(&text, &self.origin)?;
        values.iter().for_each(|(name, value)| scene.name += &format!(" {name}={value:?}"));
        // A truncated name would mean another scene: a value of 12 instead of 12.5.
        ensure!(
            scene.name.len() <= MAX_SOURCE_BYTES,
            Hinted::new(
                format!(
                    "{}: the scene's name and values take {} bytes, expected {MAX_SOURCE_BYTES} or less: `{}`",
                    self.origin,
                    scene.name.len(),
                    scene.name
                ),
                "frames carry them as the name of their source; shorten `name` and the names under `[values]`, or \
                 have fewer values"
            )
        );
        Ok(scene)
    }

    /// Returns the scene that a frame's source names, if it belongs to this file.
    ///
    /// # Errors
    /// As for [`Self::scene`].
    pub fn of_source(&self, source: &str) -> Option<Result<Scene>> {
        let values = source.strip_prefix(&head(&self.text).name)?;
        let set: Option<Values> = values.split_whitespace().map(value).collect();
        Some(self.scene(&set?))
    }
}

fn head(text: &str) -> Head {
    toml::from_str(text).unwrap_or_default()
}

fn value(text: &str) -> Option<(String, f64)> {
    let (name, value) = text.split_once('=')?;
    Some((name.to_owned(), value.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::shapes::Shape;

    const TEXT: &str = r#"
        name = "ball"
        [values]
        distance = 1.5
        size = 0.1
        [camera]
        position = [0, 0, 0]
        direction = [0, 1, 0]
        [[sphere]]
        name = "ball"
        center = [0, "$distance", 0]
        radius = "$size"
    "#;

    fn ball(scene: &Scene) -> (f64, f64) {
        let Shape::Sphere(sphere) = scene.shape(&scene.bodies[0], 0.0) else { panic!("no sphere") };
        (sphere.center.y, sphere.radius)
    }

    #[test]
    fn values_are_put_in_and_told_by_the_source() {
        let template = SceneTemplate::new(TEXT.into(), "test".into());
        assert_eq!(ball(&template.scene(&Values::new()).unwrap()), (1.5, 0.1));
        let set = Values::from([("distance".to_owned(), 0.3 + 0.1)]);
        let scene = template.scene(&set).unwrap();
        assert_eq!((scene.name.as_str(), ball(&scene)), ("ball distance=0.4 size=0.1", (0.4, 0.1)));
        assert_eq!(ball(&template.of_source(&scene.name).unwrap().unwrap()), (0.4, 0.1));
        assert!(template.of_source("another scene").is_none());
    }

    #[test]
    fn a_name_that_no_frame_can_carry_is_refused() {
        let named = |length: usize| {
            let name = format!("name = \"{}\"", "b".repeat(length));
            SceneTemplate::new(TEXT.replacen("name = \"ball\"", &name, 1), "test".into()).scene(&Values::new())
        };
        let values = " distance=1.5 size=0.1".len();
        assert_eq!(named(MAX_SOURCE_BYTES - values).unwrap().name.len(), MAX_SOURCE_BYTES);
        let told = named(MAX_SOURCE_BYTES - values + 1).unwrap_err().to_string();
        assert!(
            told.starts_with("test: the scene's name and values take 257 bytes, expected 256 or less: `bbb"),
            "{told}"
        );
        assert!(told.contains("\n  hint: "), "{told}");
    }

    #[test]
    fn a_value_that_the_file_does_not_have_is_refused() {
        let template = SceneTemplate::new(TEXT.into(), "test".into());
        let told = template.scene(&Values::from([("speed".to_owned(), 1.0)])).unwrap_err().to_string();
        assert_eq!(told, "test: the scene has no value `speed`\n  hint: values under `[values]`: distance, size");
    }
}
