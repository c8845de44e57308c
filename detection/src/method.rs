//! The method on one page: a depth image becomes ellipses, and ellipses become objects.
//!
//! [`detect`] is the whole; its two halves can run in processes of their own, which exchange lists of ellipses. Each step is
//! a call into the file that is named beside it; `docs/method.md` has the equations, `docs/method-details.md` the rest. What
//! follows, objects to tracks, is [`Tracker::update_frame`](crate::Tracker::update_frame).

use crate::assemble::arcs::Arcs;
use crate::assemble::choice::{Chosen, choose};
use crate::assemble::contours::Contours;
use crate::assemble::growth::{Growing, chain, is_promising};
use crate::assemble::place::overlap;
use crate::assemble::seeds::Seeds;
use crate::assemble::verify::verify_all;
use crate::assemble::{Assembler, AssemblerParameters, Rejection, Rejections};
use crate::extract::coarse::coarse_step;
use crate::extract::turned::turned;
use crate::extract::{ArcRejections, Extractor};
use conicflow_geometry::Scan;
use conicflow_messages::{Ellipse, Header, Object};

/// The objects of a depth image, `width * height` pixels row by row.
pub(crate) fn detect<'a>(
    extractor: &mut Extractor,
    assembler: &'a mut Assembler,
    header: &Header,
    image: &[u16],
) -> &'a [Object] {
    assembler.assemble(header, extractor.extract(header, image))
}

impl Extractor {
    /// The ellipses of a depth image (`width * height` pixels row by row), in the order of the scan lines.
    pub fn extract(&mut self, header: &Header, image: &[u16]) -> &[Ellipse] {
        // 1. Noise: how far the depths of neighbouring pixels scatter tells how noisy this image is (`noise_level.rs`), and
        //    how many neighbours share their noise (`noise_planes.rs`).
        self.noise = self.estimate_noise(header, image);
        self.ellipses.clear();
        self.rejections = ArcRejections::default();
        for &scan in self.view.parameters.scan.directions() {
            self.look_along(header, image, scan);
        }
        &self.ellipses
    }

    /// Adds the ellipses of the rows, or of the columns, of an image.
    pub(crate) fn look_along(&mut self, header: &Header, image: &[u16], scan: Scan) {
        let Self { noise, view, search, coarse, columns, ellipses, rejections, .. } = self;

        // 2. View: the rows, or the columns, as planes of rays; the largest step within one surface follows from the noise
        //    (`view.rs`). Columns are the rows of the image turned (`turned.rs`). Where noise hides the steps between surfaces,
        //    neighbouring lines are averaged (`averaging.rs`).
        view.turn(header, scan, noise);
        let image = if scan == Scan::Row { image } else { turned(image, view.lines as usize, columns) };
        let (step, coarse_step) = (view.step, coarse_step(view.step));

        // 3. Coarse lines: every sixth is cut into arcs as a whole. Runs end at jumps and holes (`line.rs`), running sums give
        //    the moments of any interval (`rays.rs`, `run.rs`), segments end where neither a line nor a circle explains their
        //    points (`segments.rs`), and what is surely curved is an arc with its contour (`arc.rs`).
        coarse.clear();
        for number in (0..view.lines).step_by(coarse_step as usize) {
            let whole = (number, 0..view.length);
            coarse.add(&view.plane(number), |arcs| search.arcs_of(view, image, whole, arcs, rejections));
        }

        // 4. The lines between them: the same, but only beside what is curved in the coarse lines (`coarse.rs`).
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
    /// The objects that the ellipses of one image form.
    pub fn assemble(&mut self, header: &Header, ellipses: &[Ellipse]) -> &[Object] {
        let Self { parameters, arcs, seeds, growing, contours, objects, candidates, rejections } = self;
        let deadline = parameters.deadline();
        objects.clear();
        candidates.clear();
        *rejections = Rejections::default();

        // 5. Arcs: each ellipse brings the moments of its points, free of the noise's bias (`arcs.rs`). The more surely an arc is
        //    bent, the sooner it is a seed; the oftener something grew in vain on its surface, the later (`seeds.rs`).
        arcs.read(header, ellipses);
        seeds.order(arcs, deadline);
        contours.next_image(&header.camera, parameters.pooled.contour_memory);

        while let Some(seed) = seeds.next(arcs, rejections) {
            match object_around(seed, arcs, seeds, growing, contours, parameters) {
                // 10. Decision: all evidence together tells how probable it is that this is an object (`odds.rs`); where there is
                //     one already, there is no other (`place.rs`). The arcs that an object explains are taken out before the next
                //     seed is tried, and what it shows of where this sensor puts contours helps the next objects (`contours.rs`).
                Ok(Chosen { candidate, object, evidence }) => {
                    candidates.push((object, evidence));
                    let is_probable = f64::from(object.confidence) >= parameters.min_confidence;
                    if is_probable && !objects.iter().any(|other| overlap(other, &object)) {
                        contours.learn(&candidate.region, &object);
                        seeds.take(&candidate, &object);
                        objects.push(object);
                        continue;
                    }
                    rejections.count(if is_probable { Rejection::Overlap } else { Rejection::Odds });
                    // From any other of its arcs the same would grow.
                    seeds.pass_over(candidate.region.members);
                }
                // Blobs of noise are the most curved of all, and cost no fit: they use up nothing.
                Err(Rejection::FewRows) => {
                    rejections.count(Rejection::FewRows);
                    seeds.pass_over(&growing.chain);
                    continue;
                }
                Err(reason) => rejections.count(reason),
            }
            seeds.give_up(arcs, &growing.chain, parameters.max_gap());
        }
        objects
    }
}

/// The object around a seed, or why there is none.
fn object_around<'a>(
    seed: usize,
    arcs: &'a Arcs,
    seeds: &Seeds,
    growing: &'a mut Growing,
    contours: &mut Contours,
    parameters: &AssemblerParameters,
) -> Result<Chosen<'a>, Rejection> {
    let free = |arc: usize| seeds.is_free(arc);

    // 6. Chain: the seed with its neighbours in the next lines; they have to be enough, and surely curved together
    //    (`growth.rs`).
    chain(arcs, seed, parameters.max_gap(), free, &mut growing.chain);
    is_promising(arcs, &growing.chain, parameters)?;

    // 7. Growth: a sphere, a cylinder and a cone each take in, line after line, the arcs that they explain, and are fitted
    //    anew to the moments of all of them, until it is surely larger than objects are (`growth.rs`, `model.rs`).
    let grown = growing.models(arcs, parameters, free);

    // 8. Verification: each is fitted together with the contour that it shows; enough of it has to be seen, surely curved and
    //    near its surface, for it to be a candidate (`verify.rs`).
    let verified = verify_all(arcs, grown, &growing.members, parameters, contours);

    // 9. Choice: the shape that explains most points with the fewest parameters, told with its uncertainty (`choice.rs`,
    //    `report.rs`).
    choose(verified, parameters, contours)
}
