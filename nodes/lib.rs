//! The stages of conicflow as thin adapters around the detection and the laboratory, by what they are; their table; and the
//! command line.

pub mod commands;
mod config_error;
pub mod detection;
mod network;
pub mod recording;
pub mod sinks;
pub mod sources;
pub mod tracking;

use conicflow_dataflow::{Node, Registry, Variant};
use conicflow_messages::{AnyByte, Ellipse, Object, Track};
use detection::{ObjectAssembler, RansacEllipseExtractor, RowEllipseExtractor};
use sinks::{
    ConsoleSink, EvaluationSink, JsonSink, McapSink, MeasurementSink, NoiseEstimator, PictureSink, SectionSink,
};
use sources::{ImageSource, McapSource, SyntheticSource};
use tracking::{Follower, KalmanTracker};

/// The nodes that a pipeline file may name: one row makes one available.
pub const NODES: &[Node] = &[
    Node::source::<SyntheticSource>(),
    Node::source::<ImageSource>(),
    Node::source::<McapSource>(),
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
    Node::stages::<McapSink<AnyByte>>(&[Variant::stage::<McapSink<AnyByte>>(), Variant::stage::<McapSink<u16>>()]),
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

/// What this program has built in, and beside it.
pub const REGISTRY: Registry = Registry { nodes: NODES, network: Some(network::NETWORK) };
