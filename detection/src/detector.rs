//! The detector: takes depth images of one camera, returns objects.

use crate::assemble::odds::Evidence;
use crate::assemble::{Assembler, AssemblerParameters};
use crate::extract::{Extractor, ExtractorParameters};
use crate::method;
use conicflow_messages::{Camera, Header, Hinted, Item, NoiseModel, Object, finest_scale, is_too_far, quantise};
use std::error::Error;
use std::fmt::{self, Display, Formatter};

/// Finds spheres, cylinders and cones in the depth images of one camera, one after another.
///
/// Later images benefit from the errors of silhouettes that objects in earlier images showed. So the same images in the same
/// order give bitwise the same objects, and in another order slightly different ones. [`alone`](Self::alone) processes each image
/// independently.
///
/// Without [`noise`](Self::noise) the sensor counts as a Kinect v1, as in the sources of a pipeline. The noise level is estimated
/// from each image, so a model that is slightly wrong costs little; but no sensor is ideal.
#[derive(Debug)]
pub struct Detector {
    header: Header,
    extractor: Extractor,
    assembler: Assembler,
    /// An image that came in metres, converted to units.
    units: Vec<u16>,
    /// Number of pixels beyond the range of units, in the last image that came in metres.
    too_far: u64,
    /// Whether each image is processed as if it were the first.
    alone: bool,
}

/// Reason why an image cannot be processed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DetectError {
    /// The image and the camera differ in their number of pixels.
    Size {
        /// Pixels of the image.
        actual: usize,
        /// Columns of the camera.
        width: u32,
        /// Rows of the camera.
        height: u32,
    },
    /// The header has numbers that no camera can have.
    Camera(String),
}

impl DetectError {
    /// Returns what is wrong and what to do about it.
    pub fn hinted(&self) -> Hinted {
        match self {
            Self::Size { actual, width, height } => Hinted::new(
                format!("the depth image has {actual} pixels, but the camera has {width}x{height}"),
                "give it row by row and in whole, without padding, and check the camera's width and height",
            ),
            Self::Camera(reason) => Hinted::new(
                format!("the image, the camera, the depth scale or the noise cannot be used: {reason}"),
                "focal lengths are in pixels, the depth scale is in metres per unit (0.001 for millimetres)",
            ),
        }
    }
}

impl Display for DetectError {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        self.hinted().fmt(formatter)
    }
}

impl Error for DetectError {}

impl Detector {
    /// Creates a detector for images of this camera in millimetres, with the noise of a Kinect v1.
    pub fn new(camera: Camera) -> Self {
        Self {
            header: Header { camera, depth_scale: 0.001, noise: NoiseModel::KINECT_V1, ..Header::default() },
            extractor: Extractor::new(ExtractorParameters::default()),
            assembler: Assembler::new(AssemblerParameters::default()),
            units: Vec::new(),
            too_far: 0,
            alone: false,
        }
    }

    /// Sets the depth noise of the sensor.
    #[must_use]
    pub fn noise(mut self, noise: NoiseModel) -> Self {
        self.header.noise = noise;
        self
    }

    /// Sets the size of a pixel's unit: 0.001 for millimetres.
    #[must_use]
    pub fn depth_scale(mut self, metres_per_unit: f64) -> Self {
        self.header.depth_scale = metres_per_unit;
        self
    }

    /// Sets the parameters of the stages `row_ellipse_extractor` and `object_assembler`.
    #[must_use]
    pub fn parameters(mut self, extractor: ExtractorParameters, assembler: AssemblerParameters) -> Self {
        self.extractor = Extractor::new(extractor);
        self.assembler = Assembler::new(assembler);
        if self.alone { self.alone() } else { self }
    }

    /// Processes each image as if it were the first (`contour_memory = 0`).
    #[must_use]
    pub fn alone(mut self) -> Self {
        self.alone = true;
        self.assembler.parameters.pooled.contour_memory = 0.0;
        self
    }

    /// Checks that images of this camera can exist, as [`try_detect`](Self::try_detect) does with each.
    ///
    /// # Errors
    /// The camera, the depth scale or the noise has numbers that no camera can have.
    pub fn check(&self) -> Result<(), DetectError> {
        check(&self.header)
    }

    /// Returns the objects of a depth image, in the camera frame. The image has `width * height` pixels, row by row, in units of
    /// the depth scale; 0 and 65535 mean no measurement.
    ///
    /// # Panics
    /// The image has another size than the camera, or the camera has numbers that no camera can have;
    /// [`try_detect`](Self::try_detect) returns an error then.
    pub fn detect(&mut self, depth: &[u16]) -> Vec<Object> {
        let objects = self.try_detect(depth);
        assert!(objects.is_ok(), "{}", objects.err().map(|error| error.to_string()).unwrap_or_default());
        objects.unwrap_or_default()
    }

    /// Returns the objects of a depth image in metres, whatever the depth scale. Values that are not finite or not positive, or
    /// beyond 16.38 m, mean no measurement.
    ///
    /// # Panics
    /// As [`detect`](Self::detect) does.
    pub fn detect_f32(&mut self, depth_m: &[f32]) -> Vec<Object> {
        let objects = self.try_detect_f32(depth_m);
        assert!(objects.is_ok(), "{}", objects.err().map(|error| error.to_string()).unwrap_or_default());
        objects.unwrap_or_default()
    }

    /// Returns the objects as [`detect`](Self::detect) does.
    ///
    /// # Errors
    /// The image has another size than the camera, or the camera has numbers that no camera can have.
    pub fn try_detect(&mut self, depth: &[u16]) -> Result<Vec<Object>, DetectError> {
        let header = self.header;
        self.detect_with(&header, depth)
    }

    /// Returns the objects as [`detect_f32`](Self::detect_f32) does.
    ///
    /// # Errors
    /// As of [`try_detect`](Self::try_detect).
    pub fn try_detect_f32(&mut self, depth_m: &[f32]) -> Result<Vec<Object>, DetectError> {
        let depth_scale = finest_scale(depth_m, 1.0);
        let mut units = std::mem::take(&mut self.units);
        units.clear();
        units.extend(depth_m.iter().map(|&z| quantise(z, 1.0 / depth_scale)));
        let header = Header { depth_scale, ..self.header };
        let objects = self.detect_with(&header, &units);
        self.too_far = depth_m.iter().filter(|z| is_too_far(**z, 1.0 / depth_scale)).count() as u64;
        self.units = units;
        objects
    }

    fn detect_with(&mut self, header: &Header, image: &[u16]) -> Result<Vec<Object>, DetectError> {
        let Camera { width, height, .. } = header.camera;
        check(header)?;
        self.too_far = 0;
        if image.len() != width as usize * height as usize {
            return Err(DetectError::Size { actual: image.len(), width, height });
        }
        Ok(method::detect(&mut self.extractor, &mut self.assembler, header, image).to_vec())
    }

    /// Returns the standard deviations of the noise in the near and in the far half of the last image, relative to the noise
    /// model. If they are far from 1, the model does not fit the sensor.
    pub fn noise_ratios(&self) -> [f64; 2] {
        self.extractor.noise_ratios()
    }

    /// Returns all candidates of the last image, reported or not, with the evidence for and against each.
    pub fn candidates(&self) -> &[(Object, Evidence)] {
        self.assembler.candidates()
    }

    /// Returns the reasons for which arcs and candidates of the last image were rejected, each with its number; also the number
    /// of pixels beyond 16.38 m in an image in metres. If these are all pixels, the image was in millimetres.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let too_far = (self.too_far > 0).then_some(("pixels farther than 16.38 m", self.too_far));
        too_far.into_iter().chain(self.extractor.rejections()).chain(self.assembler.rejections())
    }
}

fn check(header: &Header) -> Result<(), DetectError> {
    header.check(u16::NAME).map_err(|malformed| DetectError::Camera(malformed.what))
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_geometry::Vector3;
    use conicflow_lab::rendered::{KINECT_HALF, plane, render, sphere};

    fn scene() -> (Header, Vec<u16>) {
        let ball = sphere(Vector3::new(0.1, 0.0, 1.3), 0.15);
        let wall = plane(Vector3::z(), 2.5);
        render(KINECT_HALF, NoiseModel::KINECT_V1, &[ball, wall], 3)
    }

    #[test]
    fn a_detector_finds_what_the_stages_find() {
        let (header, pixels) = scene();
        let mut extractor = Extractor::new(ExtractorParameters::default());
        let mut assembler = Assembler::new(AssemblerParameters::default());
        let expected = assembler.assemble(&header, extractor.extract(&header, &pixels)).to_vec();
        assert_eq!((expected.len(), detector(&header).detect(&pixels)), (1, expected));
    }

    fn detector(header: &Header) -> Detector {
        Detector::new(header.camera).noise(header.noise).depth_scale(header.depth_scale)
    }

    #[test]
    fn alone_an_image_leaves_nothing_behind() {
        let (header, pixels) = scene();
        let with_parameters =
            |detector: Detector| detector.parameters(ExtractorParameters::default(), AssemblerParameters::default());
        // The order of the two calls does not matter.
        let [last, first] = [with_parameters(detector(&header)).alone(), with_parameters(detector(&header).alone())];
        for mut detector in [last, first] {
            let first = detector.detect(&pixels);
            assert_eq!((first.len(), detector.detect(&pixels)), (1, first));
        }
    }

    /// Images of balls before a wall, each at its own place.
    fn balls() -> Vec<(Header, Vec<u16>)> {
        let place = |seed: u64| Vector3::new(0.3 * (seed % 8) as f64 - 1.05, 0.3 * (seed / 8) as f64 - 0.6, 2.6);
        let bodies = |seed: u64| [sphere(place(seed), 0.1), plane(Vector3::z(), 3.5)];
        (0..40).map(|seed| render(KINECT_HALF, NoiseModel::KINECT_V1, &bodies(seed), seed)).collect()
    }

    /// The image with everything nearer than three metres narrowed by some pixels on either side of each row, because the sensor
    /// loses pixels at grazing incidence.
    fn narrowed((header, pixels): &(Header, Vec<u16>), by: impl Fn(usize) -> usize) -> Vec<u16> {
        let is_far = |z: u16| f64::from(z) * header.depth_scale > 3.0;
        let narrow = |(number, row): (usize, &[u16])| -> Vec<u16> {
            let around = |u: usize| u.saturating_sub(by(number))..(u + by(number) + 1).min(row.len());
            (0..row.len()).map(|u| around(u).map(|v| row[v]).find(|z| is_far(*z)).unwrap_or(row[u])).collect()
        };
        pixels.chunks(header.camera.width as usize).enumerate().flat_map(narrow).collect()
    }

    #[test]
    fn images_show_where_the_sensor_puts_contours() {
        let images = balls();
        let header = images[0].0;
        let bias = |detector: &mut Detector| {
            let radius = |image: &(Header, Vec<u16>)| detector.detect(&narrowed(image, |_| 2))[0].radius;
            let radii: Vec<f64> = images.iter().map(radius).collect();
            radii[20..].iter().sum::<f64>() / 20.0 - 0.1
        };
        let [before, after] = [bias(&mut detector(&header).alone()), bias(&mut detector(&header))];
        assert!(before < -0.0005 && after > 0.5 * before, "{before} {after}");
    }

    #[test]
    fn images_show_how_far_contours_scatter() {
        let images = balls();
        let sigma = |ragged: usize| {
            let mut detector = detector(&images[0].0);
            let by = |row: usize| if ragged == 0 { 1 } else { row * 7 % ragged };
            images.iter().map(|image| detector.detect(&narrowed(image, by))[0].sigma.radius).last().unwrap()
        };
        let [even, ragged] = [0, 4].map(sigma);
        assert!(ragged > 1.3 * even, "{even} {ragged}: of ragged contours a radius is less sure");
    }

    #[test]
    fn metres_are_as_good_as_units() {
        let (header, pixels) = scene();
        let metre = |&z: &u16| if z == 0 { f32::NAN } else { f32::from(z) * header.depth_scale as f32 };
        let metres: Vec<f32> = pixels.iter().map(metre).collect();
        let [in_metres, in_units] = [detector(&header).detect_f32(&metres), detector(&header).detect(&pixels)];
        assert_eq!(in_metres, in_units, "both are in tenths of a millimetre");
        let (mut detector, millimetres) = (detector(&header), Vec::from_iter(metres.iter().map(|z| 1000.0 * z)));
        assert!(detector.detect_f32(&millimetres).is_empty());
        let measured = pixels.iter().filter(|&&z| z > 0).count() as u64;
        assert_eq!(detector.rejections().next(), Some(("pixels farther than 16.38 m", measured)));
        detector.detect(&pixels);
        assert!(detector.rejections().all(|(reason, _)| !reason.starts_with("pixels")), "that was the image before");
    }

    #[test]
    fn without_a_word_on_noise_there_is_noise() {
        let (header, pixels) = scene();
        let objects = Detector::new(header.camera).depth_scale(header.depth_scale).detect(&pixels);
        let radius_error = (objects[0].radius - 0.15).abs();
        assert!(objects.len() == 1 && objects[0].sigma.radius > 1e-4 && radius_error < 0.005, "{objects:?}");
    }

    #[test]
    fn what_is_no_image_of_the_camera_is_an_error_with_a_hint() {
        let camera = KINECT_HALF;
        let size = Detector::new(camera).try_detect(&[0; 12]).unwrap_err();
        assert_eq!(size, DetectError::Size { actual: 12, width: 320, height: 240 });
        let mut unfocused = Detector::new(Camera { fx: f64::NAN, ..camera });
        let focal = unfocused.try_detect_f32(&vec![1.0; 320 * 240]).unwrap_err();
        assert_eq!((Detector::new(camera).check(), unfocused.check()), (Ok(()), Err(focal.clone())));
        for error in [size, focal, Detector::new(camera).depth_scale(0.0).try_detect(&[]).unwrap_err()] {
            assert!(error.to_string().contains("\n  hint: "), "{error}");
        }
    }

    #[test]
    #[should_panic(expected = "has 12 pixels")]
    fn detect_panics_where_try_detect_has_an_error() {
        Detector::new(KINECT_HALF).detect(&[0; 12]);
    }
}
