//! Pictures of both variants side by side: each frame with the objects of A at the left, and those of B at the right.

use super::report::words;
use super::variant::{Frame, Variant};
use crate::sinks::picture_sink::{Config, Painter, write_beside};
use crate::sources::mcap_source::Replay;
use anyhow::{Context as _, Result};
use conicflow_lab::score::pairing::{Paired, pair_up};
use conicflow_messages::{Message, Object};
use std::fs;
use std::path::Path;

/// Writes a picture of each frame into a folder, which is created if it is missing.
///
/// # Errors
/// A picture cannot be written, or the recorded depth images cannot be read.
pub(super) fn write(folder: &Path, zoom: u32, [a, b]: [&Variant; 2], sets: [&[String]; 2]) -> Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("the folder `{}` cannot be made", folder.display()))?;
    let config = Config { zoom, ..Config::default() };
    let side = |variant: &Variant, title: &str, set: &[String]| -> Result<Side> {
        Ok(Side { painter: Painter::new(&config).titled(format!("{title}: {}", words(set))), depth: variant.depth()? })
    };
    let (mut left, mut right) = (side(a, "A", sets[0])?, side(b, "B", sets[1])?);
    let mut file = Vec::new();
    for (in_a, in_b) in a.frames.iter().zip(&b.frames) {
        let Paired { only_a, only_b, .. } = pair_up(&in_a.objects(), &in_b.objects());
        left.draw(in_a, &only_a, "only A")?;
        right.draw(in_b, &only_b, "only B")?;
        let path = folder.join(format!("frame_{:06}.png", in_a.header.sequence));
        write_beside([&left.painter, &right.painter], &mut file, &path)?;
    }
    Ok(())
}

/// The half of a picture for one variant.
struct Side {
    painter: Painter,
    depth: Replay,
}

impl Side {
    /// Draws the variant's objects of a frame, with `word` on those that the other variant does not have.
    fn draw(&mut self, frame: &Frame, alone: &[usize], word: &str) -> Result<()> {
        self.painter.begin(&frame.header.camera);
        while let Some(depth) = self.depth.next_message()? {
            if depth.header.sequence == frame.header.sequence {
                self.painter.depth(&Message { header: &depth.header, items: &depth.items_as() });
                break;
            }
        }
        for (number, object) in frame.objects().iter().enumerate() {
            self.painter.object(object, alone.contains(&number).then_some(word));
        }
        self.painter.finish(&frame.header);
        Ok(())
    }
}

impl Frame {
    /// Returns the objects that were found in the frame.
    pub(super) fn objects(&self) -> Vec<Object> {
        self.answers.iter().map(|answer| answer.object).collect()
    }
}
