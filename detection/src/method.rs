//! The method on one page: a depth image becomes ellipses, and ellipses become objects.
//!
//! [`detect`] is the whole method. Its two halves can run in separate processes, which exchange lists of ellipses. Each step
//! calls the file named beside it; `docs/method.md` has the equations, `docs/method-details.md` the
//! derivations. [`Tracker::update_frame`](crate::Tracker::update_frame) continues from objects to tracks.

use crate::assemble::arcs::Arcs;
use crate::assemble::choice::{Chosen, choose};
use crate::assemble::contours::ContourCalibration;
use crate::assemble::growth::{RegionGrower, chain, is_promising};
use crate::assemble::odds::Evidence;
use crate::assemble::place::overlap;
use crate::assemble::seeds::Seeds;
use crate::assemble::verify::verify_all;
use crate::assemble::{Assembler, AssemblerParameters, Rejection, Rejections};
use crate::extract::coarse::coarse_step;
use crate::extract::noise_estimate::NoiseEstimate;
use crate::extract::transposed::transposed;
use crate::extract::{ArcRejections, Extractor, noise_level, noise_planes};
use conicflow_geometry::Scan;
use conicflow_messages::{Ellipse, Header, Object};

/// Returns the objects of a depth image, `width * height` pixels row by row.
pub(crate) fn detect<'a>(
    extractor: &mut Extractor,
    assembler: &'a mut Assembler,
    header: &Header,
    image: &[u16],
) -> &'a [Object] {
    assembler.assemble(header, extractor.extract(header, image))
}

impl Extractor {
    /// Returns the ellipses of a depth image (`width * height` pixels row by row), in the order of the scan lines.
    ///
    /// The header's camera and depth scale have to be those of the image. Its noise model gives the growth of the noise with the
    /// depth, and a first guess of its level, which is then estimated from the image. `Header::default()` has
    /// [`NoiseModel::IDEAL`](conicflow_messages::NoiseModel::IDEAL): a sensor without noise. [`Detector`](crate::Detector) takes
    /// the same steps and starts from the noise of a Kinect v1.
    pub fn extract(&mut self, header: &Header, image: &[u16]) -> &[Ellipse] {
        self.noise = self.estimate_noise(header, image);
        self.ellipses.clear();
        self.rejections = ArcRejections::default();
        for &scan in self.view.parameters.scan.directions() {
            self.search_along(header, image, scan);
        }
        &self.ellipses
    }

    /// Estimates the noise of an image.
    pub(crate) fn estimate_noise(&mut self, header: &Header, image: &[u16]) -> NoiseEstimate {
        let Self { view, search, samples, squares, .. } = self;

        // 1. Noise: the scatter of neighbouring depths gives its level (`noise_level.rs`); its correlation on planes gives how
        //    many neighbours share their noise (`noise_planes.rs`). From both follows how many lines have to be averaged for the
        //    step between two surfaces to be seen (`averaging.rs`).
        let noise = noise_level::estimate(view, (header, image), search, samples);
        view.set_up(header, Scan::Row, &noise);
        let correlation_px = noise_planes::correlation_px(view, image, squares);
        let noise = NoiseEstimate { correlation_px, ..noise };
        let depths = samples.range();
        let averaged = [Scan::Row, Scan::Column].map(|scan| {
            view.set_up(header, scan, &noise);
            view.lines_to_average(depths)
        });
        NoiseEstimate { averaged, ..noise }
    }

    /// Adds the ellipses of the rows, or of the columns, of an image.
    pub(crate) fn search_along(&mut self, header: &Header, image: &[u16], scan: Scan) {
        let Self { noise, view, search, coarse, columns, ellipses, rejections, .. } = self;

        // 2. View: the rows, or the columns, become planes of rays; the largest step within one surface follows from the noise
        //    (`view.rs`). Columns are the rows of the transposed image (`transposed.rs`). Where noise hides the steps between
        //    surfaces, neighbouring lines are averaged (`averaging.rs`).
        view.set_up(header, scan, noise);
        let image = if scan == Scan::Row { image } else { transposed(image, view.lines as usize, columns) };
        let (step, coarse_step) = (view.step, coarse_step(view.step));

        // 3. Coarse lines: every sixth line is cut into arcs as a whole. Runs end at jumps and holes (`line.rs`), running sums
        //    give the moments of any interval (`rays.rs`, `run.rs`), segments end where neither a line nor a circle explains
        //    their points (`segments.rs`), and a surely curved segment is an arc with its contour (`arc.rs`).
        coarse.clear();
        for number in (0..view.lines).step_by(coarse_step as usize) {
            let whole = (number, 0..view.length);
            coarse.add(&view.plane(number), |arcs| search.arcs_of(view, image, whole, arcs, rejections));
        }

        // 4. The lines between: the same, but only beside curved arcs of the coarse lines (`coarse.rs`).
        for (index, number) in (0..view.lines + coarse_step).step_by(coarse_step as usize).enumerate() {
            let between = (number + step).saturating_sub(coarse_step)..number.min(view.lines);
            let windows = coarse.windows_before(index, view.length);
            for number in between.step_by(step as usize) {
                for window in windows {
                    search.arcs_of(view, image, (number, window.clone()), ellipses, rejections);
                }
            }
            ellipses.extend_from_slice(coarse.arcs(index));
        }
        ellipses.iter_mut().for_each(|ellipse| ellipse.line_step = step);
    }
}

impl Assembler {
    /// Returns the objects that the ellipses of one image form. `header` is that of the image: see [`Extractor::extract`].
    pub fn assemble(&mut self, header: &Header, ellipses: &[Ellipse]) -> &[Object] {
        let Self { parameters, arcs, seeds, grower, contours, objects, candidates, rejections } = self;
        let deadline = parameters.deadline();
        objects.clear();
        candidates.clear();
        *rejections = Rejections::default();

        // 5. Arcs: each ellipse brings the moments of its points, without the bias of the noise (`arcs.rs`). An arc that is more
        //    surely curved is a seed sooner, and one on a surface where growth failed more often is a seed later (`seeds.rs`).
        arcs.read(header, ellipses);
        seeds.order(arcs, deadline);
        contours.next_image(&header.camera, parameters.pooled.contour_memory);

        while let Some(seed) = seeds.next(arcs, rejections) {
            let found = object_around(seed, arcs, seeds, grower, contours, parameters);
            match found.and_then(|chosen| decide(chosen, objects, candidates, seeds, contours, parameters)) {
                Ok(()) => continue,
                // Too few lines: most such chains are blobs of noise, which are the most strongly curved and mostly cost no fit.
                // They do not count as failed growth.
                Err(Rejection::FewLines) => {
                    rejections.count(Rejection::FewLines);
                    seeds.exclude(&grower.chain);
                }
                Err(reason) => {
                    rejections.count(reason);
                    seeds.give_up(arcs, &grower.chain, parameters.max_gap());
                }
            }
        }
        objects
    }
}

/// Returns the object around a seed, or why there is none.
fn object_around<'a>(
    seed: usize,
    arcs: &'a Arcs,
    seeds: &Seeds,
    grower: &'a mut RegionGrower,
    contours: &mut ContourCalibration,
    parameters: &AssemblerParameters,
) -> Result<Chosen<'a>, Rejection> {
    let free = |arc: usize| seeds.is_free(arc);

    // 6. Chain: the seed with its neighbours in the next lines, which have to be numerous and surely curved together
    //    (`growth.rs`).
    chain(arcs, seed, parameters.max_gap(), free, &mut grower.chain);
    is_promising(arcs, &grower.chain, parameters)?;

    // 7. Growth: a sphere, a cylinder and a cone each take in, line after line, the arcs that they explain, and are fitted
    //    again to the moments of all of them, or given up when surely larger than the limits (`growth.rs`, `model.rs`).
    let grown = grower.models(arcs, parameters, free);

    // 8. Verification: each model is fitted together with its contour; to be a candidate, it has to be seen well enough,
    //    surely curved and near its points (`verify.rs`).
    let verified = verify_all(arcs, grown, &grower.members, parameters, contours);

    // 9. Choice: the shape that explains most points with the fewest parameters, reported with its uncertainty
    //    (`choice.rs`, `report.rs`).
    choose(verified, parameters, contours)
}

/// Adds the chosen candidate to the objects, or returns why it is not one.
fn decide(
    Chosen { candidate, object, evidence }: Chosen,
    objects: &mut Vec<Object>,
    candidates: &mut Vec<(Object, Evidence)>,
    seeds: &mut Seeds,
    contours: &mut ContourCalibration,
    parameters: &AssemblerParameters,
) -> Result<(), Rejection> {
    candidates.push((object, evidence));

    // 10. Decision: all evidence together gives the probability of an object (`odds.rs`); there is only one object in one
    //     place (`place.rs`). The arcs that an object explains are removed before the next seed is tried, and the errors of
    //     contours that it shows improve the next objects (`contours.rs`).
    let is_probable = f64::from(object.confidence) >= parameters.min_confidence;
    if is_probable && !objects.iter().any(|other| overlap(other, &object)) {
        contours.learn(&candidate.region, &object);
        seeds.take(&candidate, &object);
        objects.push(object);
        return Ok(());
    }
    // Growth from any other of its arcs would give the same.
    seeds.exclude(candidate.region.members);
    Err(if is_probable { Rejection::Overlap } else { Rejection::Odds })
}
