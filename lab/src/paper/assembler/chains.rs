//! Connected components by the distance of centres: chains with at most one section per line.
//!
//! A section joins the chain with the nearest centre among its last k members, if that is within the margin phi. So a chain
//! survives a few noisy lines, and a noisy section does not end it.

use super::parameters::ProfileConfig;
use super::sections::Section;

/// Returns the chains of the sections, which are sorted by line; each chain is a list of indices in that order.
pub(super) fn link(sections: &[Section], config: &ProfileConfig) -> Vec<Vec<usize>> {
    let mut chains: Vec<Vec<usize>> = Vec::new();
    // Chains that may still grow.
    let mut open: Vec<usize> = Vec::new();
    for (index, section) in sections.iter().enumerate() {
        open.retain(|&chain| chains[chain].last().is_some_and(|&last| reaches(&sections[last], section, config)));
        let distances = open.iter().filter_map(|&chain| {
            let members = chains[chain].iter().rev().take(config.profile.neighbors as usize);
            let near = members.filter_map(|&member| step(&sections[member], section, config));
            near.min_by(f64::total_cmp).map(|distance| (distance, chain))
        });
        match distances.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((_, chain)) => chains[chain].push(index),
            None => {
                open.push(chains.len());
                chains.push(vec![index]);
            }
        }
    }
    chains
}

/// Whether the line of a section is near enough to the last one of a chain.
fn reaches(last: &Section, section: &Section, config: &ProfileConfig) -> bool {
    last.plane.scan() == section.plane.scan() && section.line - last.line <= config.profile.max_gap_lines
}

/// Returns the distance of two centres, if they are on different lines and within the margin.
fn step(a: &Section, b: &Section, config: &ProfileConfig) -> Option<f64> {
    let lines = f64::from(b.line - a.line);
    let radius = a.radius.min(b.radius);
    let margin = config.profile.max_center_step_m + config.profile.max_center_step_radii * radius + lines * a.spacing;
    let distance = (a.center - b.center).norm();
    (lines > 0.0 && distance <= margin).then_some(distance)
}
