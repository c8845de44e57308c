//! Depth images -> depth images, objects -> objects: rotated or mirrored by [`Flip`], as stages. One before the extractor shows
//! whether the detection prefers a direction; another one after the assembler turns its objects back.

use conicflow_dataflow::{Context, Output, SideInputs, Stage, StageError};
use conicflow_lab::flip::Flip;
use conicflow_messages::{Camera, Item, Message, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::marker::PhantomData;

/// Parameters of `depth_flipper` and `object_flipper`.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FlipperConfig {
    /// Rotation or mirroring of the image, and of the camera with it. A mirrored frame loses its pose.
    pub flip: Flip,
}

/// Items that can be flipped.
pub trait Flipped: Item {
    /// Name of the node.
    const NODE: &'static str;
    /// Summary of the node.
    const SUMMARY: &'static str;

    /// Writes the items as the flipped camera sees them, from those that `camera` sees.
    ///
    /// # Errors
    /// There is no memory for the items.
    fn flip(flip: Flip, camera: &Camera, items: &[Self], output: &mut Output<Self>) -> Result<(), StageError>;
}

impl Flipped for u16 {
    const NODE: &'static str = "depth_flipper";
    const SUMMARY: &'static str = "Turns or mirrors depth images, and the camera with them";

    fn flip(flip: Flip, camera: &Camera, pixels: &[Self], output: &mut Output<Self>) -> Result<(), StageError> {
        flip.image(camera, pixels, output.loan(pixels.len())?);
        Ok(())
    }
}

impl Flipped for Object {
    const NODE: &'static str = "object_flipper";
    const SUMMARY: &'static str = "Turns or mirrors objects, and the camera that saw them";

    fn flip(flip: Flip, _: &Camera, objects: &[Self], output: &mut Output<Self>) -> Result<(), StageError> {
        objects.iter().for_each(|object| output.push(flip.object(object)));
        Ok(())
    }
}

/// The stage.
pub struct Flipper<T> {
    flip: Flip,
    items: PhantomData<T>,
}

impl<T: Flipped> Stage for Flipper<T> {
    const NAME: &'static str = T::NODE;
    const SUMMARY: &'static str = T::SUMMARY;
    type Config = FlipperConfig;
    type Input = T;
    type Output = T;

    fn new(config: Self::Config, _: &Context) -> Result<Self, StageError> {
        Ok(Self { flip: config.flip, items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, output: &mut Output<T>) -> Result<(), StageError> {
        output.header = self.flip.header(input.header);
        T::flip(self.flip, &input.header.camera, input.items, output)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::testing::pass;
    use conicflow_messages::Header;

    #[test]
    fn images_objects_and_camera_are_flipped_together() {
        let camera = Camera { width: 3, height: 2, fx: 5.0, fy: 6.0, cx: 0.75, cy: 0.5 };
        let header = Header { camera, depth_scale: 0.001, ..Header::default() };
        let config = FlipperConfig { flip: Flip::Clockwise };
        let images = [(header, vec![1, 2, 3, 4, 5, 6])];
        let image = &pass::<Flipper<u16>>(config.clone(), Context::default(), &images).unwrap()[0];
        assert_eq!((image.0.camera.width, image.0.camera.height, &image.1[..]), (2, 3, &[4, 1, 5, 2, 6, 3][..]));
        let objects = [(header, vec![Object { center: [0.1, 0.2, 1.0], ..Object::default() }])];
        let object = &pass::<Flipper<Object>>(config, Context::default(), &objects).unwrap()[0];
        assert_eq!((object.0.camera, object.1[0].center), (image.0.camera, [-0.2, 0.1, 1.0]));
    }
}
