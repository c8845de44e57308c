//! Experiments, as described by the table `[experiment]` of a pipeline file. The pipeline runs once for each combination of the
//! varied values. The rows of its measuring stages become one table beside the figures of the paper, a CSV file and a plot
//! ([`Results`]).
//!
//! ```toml
//! [experiment]
//! title   = "a cylinder by distance"
//! columns = ["n", "radius_m", "radius_sd_m"]         # of the rows that the measuring stages make
//! csv     = "results/accuracy.csv"
//! spread  = { by = "object", columns = ["radius_sd_m"] }          # least, median and greatest, below the table
//! sums    = [{ by = "distance", columns = ["n"] }]                # one row for each distance, and one of all
//! plot    = { path = "results/accuracy.svg", x = "distance", y = ["radius_m"], lines = ["stage"] }
//! vary    = [
//!     { name = "distance", set = ["source.values.distance"], values = [1.0, 1.5] },
//!     { name = "method", cases = [{ name = "ours" }, { name = "paper", set = { "assembler.method" = "profile" } }] },
//! ]
//! [experiment.paper]                                 # shown beside what is measured
//! match   = ["distance"]
//! columns = ["radius_m"]
//! rows    = [[1.0, 0.20], [1.5, 0.17]]
//! ```

mod axes;
mod definition;
mod output_file;
mod plot;
mod results;

pub use definition::{Case, Experiment, Exponent, Grouping, Plot, Reference, Variation, Vary};
pub use results::Results;
