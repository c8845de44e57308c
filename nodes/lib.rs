//! The stages of conicflow, one file each, in the order in which a frame meets them; their table; and the command line.

pub mod camera;
mod csv;
mod faults;
mod json_lines;
pub mod noise_config;
mod random;
mod spread;
mod turns;
mod upward;

pub mod synthetic_source;

pub mod image_source;

pub mod ransac_ellipse_extractor;
pub mod row_ellipse_extractor;

pub mod object_assembler;

pub mod kalman_tracker;

pub mod follower;

pub mod console_sink;
pub mod evaluation_sink;
pub mod json_sink;
pub mod measurement_sink;
pub mod noise_estimator;
pub mod picture_sink;

pub mod command_line;
mod doctor;
pub mod experiment;
mod node_help;
mod swap;
mod top;
mod topic;

use conicflow_dataflow::{Network, Node, Registry, Variant};
use conicflow_messages::{Ellipse, Object, Track};
use console_sink::ConsoleSink;
use evaluation_sink::EvaluationSink;
use follower::Follower;
use image_source::ImageSource;
use json_sink::JsonSink;
use kalman_tracker::KalmanTracker;
use measurement_sink::{MeasurementSink, SectionSink};
use noise_estimator::NoiseEstimator;
use object_assembler::ObjectAssembler;
use picture_sink::PictureSink;
use ransac_ellipse_extractor::RansacEllipseExtractor;
use row_ellipse_extractor::RowEllipseExtractor;
use synthetic_source::SyntheticSource;

/// The nodes that a pipeline file may name: one row makes one available.
pub const NODES: &[Node] = &[
    Node::source::<SyntheticSource>(),
    Node::source::<ImageSource>(),
    Node::stage::<RowEllipseExtractor>(),
    Node::stage::<RansacEllipseExtractor>(),
    Node::stage::<ObjectAssembler>(),
    Node::stage::<KalmanTracker>(),
    Node::stage::<Follower>(),
    Node::stages::<ConsoleSink<Track>>(&[
        Variant::stage::<ConsoleSink<Track>>(),
        Variant::stage::<ConsoleSink<Object>>(),
        Variant::stage::<ConsoleSink<Ellipse>>(),
    ]),
    Node::stage::<JsonSink>(),
    Node::stages::<PictureSink<Track>>(&[
        Variant::stage::<PictureSink<Track>>(),
        Variant::stage::<PictureSink<Object>>(),
        Variant::stage::<PictureSink<Ellipse>>(),
    ]),
    Node::stages::<EvaluationSink<Object>>(&[
        Variant::stage::<EvaluationSink<Object>>(),
        Variant::stage::<EvaluationSink<Track>>(),
    ]),
    Node::stages::<MeasurementSink<Object>>(&[
        Variant::stage::<MeasurementSink<Object>>(),
        Variant::stage::<MeasurementSink<Track>>(),
    ]),
    Node::stage::<SectionSink>(),
    Node::stage::<NoiseEstimator>(),
];

#[cfg(feature = "bridge")]
const NETWORK: Option<Network> = Some(conicflow_bridge::NETWORK);
#[cfg(not(feature = "bridge"))]
const NETWORK: Option<Network> = None;

/// What this program has built in.
pub const REGISTRY: Registry = Registry { nodes: NODES, network: NETWORK };
