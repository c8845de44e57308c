//! Connected components by the proximity of centres: chains with at most one section a line.
//!
//! A section joins the chain that has the nearest centre among its last k members, if that is within the margin phi;
//! so a chain outlives a few noisy lines, and a noisy section does not end it.

use super::parameters::ProfileConfig;
use super::sections::Section;

/// The chains of one image; the buffers are used again for the next.
#[derive(Debug, Default)]
pub(super) struct Chains {
    chains: Vec<Vec<usize>>,
    used: usize,
    /// Chains that may still grow.
    open: Vec<usize>,
}

impl Chains {
    /// Links the sections, which are in the order of the lines.
    pub fn link(&mut self, sections: &[Section], config: &ProfileConfig) {
        self.used = 0;
        self.open.clear();
        for (index, section) in sections.iter().enumerate() {
            self.close(sections, section, config);
            match self.nearest(sections, section, config) {
                Some(chain) => self.chains[chain].push(index),
                None => self.start(index),
            }
        }
    }

    /// The chains, each a list of indices in the order of the lines.
    pub fn iter(&self) -> impl Iterator<Item = &[usize]> {
        self.chains[..self.used].iter().map(Vec::as_slice)
    }

    fn start(&mut self, index: usize) {
        if self.used == self.chains.len() {
            self.chains.push(Vec::new());
        }
        self.chains[self.used].clear();
        self.chains[self.used].push(index);
        self.open.push(self.used);
        self.used += 1;
    }

    /// Drops the chains that end too far before the line of `section`.
    fn close(&mut self, sections: &[Section], section: &Section, config: &ProfileConfig) {
        let chains = &self.chains;
        self.open.retain(|&chain| {
            let last = chains[chain].last().map(|&last| &sections[last]);
            last.is_some_and(|last| {
                last.plane.scan() == section.plane.scan() && section.line - last.line <= config.profile.max_gap_lines
            })
        });
    }

    fn nearest(&self, sections: &[Section], section: &Section, config: &ProfileConfig) -> Option<usize> {
        let distances = self.open.iter().filter_map(|&chain| {
            let members = self.chains[chain].iter().rev().map(|&member| &sections[member]);
            let near =
                members.take(config.profile.neighbors as usize).filter_map(|member| step(member, section, config));
            near.min_by(f64::total_cmp).map(|distance| (distance, chain))
        });
        distances.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, chain)| chain)
    }
}

/// Distance of two centres, if they are of different lines and within the margin.
fn step(a: &Section, b: &Section, config: &ProfileConfig) -> Option<f64> {
    let lines = f64::from(b.line - a.line);
    let radius = a.radius.min(b.radius);
    let margin = config.profile.max_center_step_m + config.profile.max_center_step_radii * radius + lines * a.spacing;
    let distance = (a.center - b.center).norm();
    (lines > 0.0 && distance <= margin).then_some(distance)
}
