//! The stages of conicflow as thin adapters around the detection and the laboratory, grouped by their role; the table of nodes;
//! and the command line.

pub mod commands;
mod faults;
mod network;
pub mod recording;
mod viewing;

pub mod sources {
    //! Sources of frames.

    pub mod image_source;
    pub mod mcap_source;
    pub mod sdk_camera;
    mod synthetic_source;
    pub mod v4l2_source;
    mod written_in;

    pub use image_source::ImageSource;
    pub use mcap_source::McapSource;
    pub use synthetic_source::SyntheticSource;
    pub use v4l2_source::V4l2Source;
    pub use written_in::WrittenIn;
}

pub mod detection {
    //! Depth images to ellipses, ellipses to objects; and stages that rotate or mirror images and objects.

    mod flipper;
    mod object_assembler;
    mod ransac_ellipse_extractor;
    mod row_ellipse_extractor;

    pub use flipper::Flipper;
    pub use object_assembler::{Method, ObjectAssembler, ObjectAssemblerConfig};
    pub use ransac_ellipse_extractor::RansacEllipseExtractor;
    pub use row_ellipse_extractor::{ArcFinder, RowEllipseConfig, RowEllipseExtractor};
}

pub mod tracking {
    //! Objects to tracks, and tracks to commands.

    mod follower;
    mod kalman_tracker;

    pub use follower::{Follower, FollowerConfig};
    pub use kalman_tracker::KalmanTracker;
}

pub mod sinks {
    //! Outputs of results: to people, files and pictures, and measurements of them.

    mod console_sink;
    mod decimator;
    pub mod evaluation_sink;
    pub(crate) mod json_lines;
    pub mod json_sink;
    pub mod limit_sink;
    pub mod mcap_sink;
    pub mod measurement_sink;
    mod noise_estimator;
    pub mod picture_sink;
    pub mod section_sink;
    pub mod view_sink;

    pub use console_sink::ConsoleSink;
    pub use evaluation_sink::EvaluationSink;
    pub use json_sink::JsonSink;
    pub use limit_sink::LimitSink;
    pub use mcap_sink::McapSink;
    pub use measurement_sink::MeasurementSink;
    pub use noise_estimator::NoiseEstimator;
    pub use picture_sink::PictureSink;
    pub use section_sink::SectionSink;
    pub use view_sink::ViewSink;
}

use conicflow_dataflow::{Node, Registry, Variant};
use conicflow_messages::{AnyByte, Ellipse, Object, Track};
use conicflow_ros2::{Elsewhere, Ros2Sink, Ros2Source};
use detection::{Flipper, ObjectAssembler, RansacEllipseExtractor, RowEllipseExtractor};
use sinks::{
    ConsoleSink, EvaluationSink, JsonSink, LimitSink, McapSink, MeasurementSink, NoiseEstimator, PictureSink,
    SectionSink, ViewSink,
};
use sources::sdk_camera::{AzureKinect, OakD, Orbbec, RealSense, SdkCamera};
use sources::{ImageSource, McapSource, SyntheticSource, V4l2Source};
use tracking::{Follower, KalmanTracker};

/// The nodes that a pipeline file can name: one row makes one available.
pub const NODES: &[Node] = &[
    Node::source::<SyntheticSource>(),
    Node::source::<ImageSource>(),
    Node::source::<McapSource>(),
    Node::source::<Ros2Source<Elsewhere>>().run_by(network::HOST),
    Node::source::<V4l2Source>(),
    Node::source::<SdkCamera<RealSense>>().run_by(SdkCamera::<RealSense>::HOST),
    Node::source::<SdkCamera<Orbbec>>().run_by(SdkCamera::<Orbbec>::HOST),
    Node::source::<SdkCamera<OakD>>().run_by(SdkCamera::<OakD>::HOST),
    Node::source::<SdkCamera<AzureKinect>>().run_by(SdkCamera::<AzureKinect>::HOST),
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
    Node::stages::<Ros2Sink<Track, Elsewhere>>(&[
        Variant::stage::<Ros2Sink<Track, Elsewhere>>(),
        Variant::stage::<Ros2Sink<Object, Elsewhere>>(),
    ])
    .run_by(network::HOST),
    Node::stages::<PictureSink<Track>>(&[
        Variant::stage::<PictureSink<Track>>(),
        Variant::stage::<PictureSink<Object>>(),
        Variant::stage::<PictureSink<Ellipse>>(),
    ]),
    Node::stages::<ViewSink<Track>>(&[
        Variant::stage::<ViewSink<Track>>(),
        Variant::stage::<ViewSink<Object>>(),
        Variant::stage::<ViewSink<u16>>(),
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
    Node::stage::<LimitSink>(),
    Node::stage::<NoiseEstimator>(),
    Node::stage::<Flipper<u16>>(),
    Node::stage::<Flipper<Object>>(),
];

/// The nodes and the network part of this program.
pub const REGISTRY: Registry = Registry { nodes: NODES, network: Some(network::NETWORK) };
