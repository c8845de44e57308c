//! A node as other ROS 2 nodes see it: its domain, its name and the endpoints of its topics; and checks of these.

use conicflow_dataflow::pipeline::check_endpoint;
use conicflow_messages::ConfigFault;
use conicflow_ros::Definition;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The distribution of ROS 2 on the other side.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Distro {
    /// 2022; its topics do not announce the hashes of their types.
    Humble,
    /// 2023.
    Iron,
    /// 2024.
    #[default]
    Jazzy,
    /// 2025.
    Kilted,
    /// 2026.
    Lyrical,
    /// The development distribution.
    Rolling,
}

/// The software that carries ROS 2 messages to Zenoh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Via {
    /// The robot's nodes speak Zenoh: `RMW_IMPLEMENTATION=rmw_zenoh_cpp`.
    #[default]
    RmwZenoh,
    /// The robot's nodes speak DDS, and `zenoh-bridge-ros2dds` translates.
    Ros2dds,
}

/// A ROS 2 node as the others see it.
#[derive(Clone, Debug, PartialEq)]
pub struct Participant {
    /// Zenoh endpoints of the router.
    pub connect: Vec<String>,
    /// The ROS 2 domain.
    pub domain: u32,
    /// The distribution on the other side.
    pub distro: Distro,
    /// The software that carries messages there.
    pub via: Via,
    /// The name of the node, in letters, digits and `_`.
    pub name: String,
    /// The endpoints of its topics.
    pub ends: Vec<End>,
}

/// The endpoint of a topic.
#[derive(Clone, Debug, PartialEq)]
pub struct End {
    /// The topic, with a leading slash.
    pub topic: String,
    /// The type of its messages.
    pub definition: Definition,
    /// Whether it publishes or subscribes.
    pub way: Way,
}

/// Whether an endpoint publishes or subscribes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// The endpoint publishes.
    Publish,
    /// The endpoint subscribes, with a queue of this length; a full queue drops the oldest message.
    Subscribe(usize),
    /// The endpoint subscribes, with a queue of this length, and first gets the messages that were sent before (transient local).
    SubscribeLatched(usize),
}

/// The last domain of ROS 2: with more, DDS would run out of ports.
const LAST_DOMAIN: u32 = 232;

impl Participant {
    /// Returns the faults of the router's endpoints and the domain.
    pub(crate) fn faults(connect: &[String], domain: u32) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        if connect.is_empty() {
            let hint = "write `connect = [\"tcp/127.0.0.1:7447\"]`, where the router of ROS 2 listens: `rmw_zenohd` or `zenohd`";
            faults.push(ConfigFault::new("connect", "is missing", hint));
        }
        let wrong = connect.iter().filter_map(|endpoint| check_endpoint(endpoint).err());
        faults.extend(wrong.map(|error| ConfigFault::new("connect", error.what, error.hint)));
        if domain > LAST_DOMAIN {
            let hint = "it is that of `ROS_DOMAIN_ID` on the robot; 0 where that is not set";
            let what = format!("{domain} is none, allowed is 0 to {LAST_DOMAIN}");
            faults.push(ConfigFault::new("domain", what, hint));
        }
        faults
    }

    /// Returns the ROS 2 node name of a stage.
    pub(crate) fn name_of(stage: &str) -> String {
        let word = |letter: char| if letter.is_ascii_alphanumeric() { letter } else { '_' };
        format!("conicflow_{}", stage.chars().map(word).collect::<String>())
    }
}

/// Returns the fault of a topic's name, if there is one.
pub(crate) fn topic_fault(key: &'static str, topic: &str) -> Option<ConfigFault> {
    let is_word = |part: &str| {
        let is_letter = |letter: char| letter.is_ascii_alphanumeric() || letter == '_';
        part.chars().all(is_letter) && !part.chars().next().is_none_or(|first| first.is_ascii_digit())
    };
    let is_name = topic.strip_prefix('/').is_some_and(|parts| parts.split('/').all(is_word));
    let what = format!("`{topic}` is no name of a topic");
    let hint = "a slash, then letters, digits and `_`, in parts with slashes between: \"/camera/depth/image_rect_raw\"";
    (!is_name).then(|| ConfigFault::new(key, what, hint))
}

#[cfg(test)]
mod unit_tests {
    use super::*;

    #[test]
    fn names_of_topics_are_those_of_ros() {
        for good in ["/tf", "/camera/depth/image_rect_raw", "/_a/b2"] {
            assert_eq!(topic_fault("topic", good), None, "{good}");
        }
        for bad in ["", "/", "tf", "/a//b", "/a/", "/a/2b", "/a/*", "/a b", "/ä", "/a/$*", "/a?b"] {
            assert!(topic_fault("topic", bad).is_some(), "{bad}");
        }
        assert_eq!(Participant::name_of("ros-2 é"), "conicflow_ros_2__");
    }

    #[test]
    fn a_router_and_a_domain_that_cannot_be_are_told() {
        let told = |connect: &[&str], domain| {
            let connect: Vec<_> = connect.iter().map(|&endpoint| endpoint.to_owned()).collect();
            Participant::faults(&connect, domain).iter().map(|fault| fault.key).collect::<Vec<_>>()
        };
        assert_eq!(told(&["tcp/127.0.0.1:7447"], 232), [""; 0]);
        assert_eq!(told(&[], 233), ["connect", "domain"]);
        assert_eq!(told(&["127.0.0.1"], 0), ["connect"]);
    }
}
