//! The names of ROS 2 topics, nodes and endpoints in Zenoh: the key of a topic's messages, and the liveliness tokens that
//! announce a node and its endpoints.
//!
//! | | `rmw_zenoh_cpp` | `zenoh-plugin-ros2dds` |
//! |---|---|---|
//! | key | `DOMAIN/TOPIC/TYPE/HASH` | `TOPIC` |
//! | token of a node | `@ros2_lv/DOMAIN/ZID/NODE/NODE/NN/%/%/NAME` | none |
//! | token of an endpoint | `@ros2_lv/DOMAIN/ZID/NODE/END/MP/%/%/NAME/TOPIC/TYPE/HASH/QOS` | `@/ZID/@ros2_lv/MP/TOPIC/TYPE/QOS` |
//!
//! A key contains the topic without its first slash; a token contains it with `%` or `§` in place of each slash. `MP` is a
//! publisher, `MS` a subscriber.
//!
//! From Lyrical on, publishers of `rmw_zenoh_cpp` send messages that contain a `uint8[]` below the key of the topic: for
//! subscribers without a memory backend of their own at `KEY/_buf_cpu`, if the token of each subscriber ends with
//! `/backends:cpu:`, which earlier distributions ignore. They also send at the key itself if there are other subscribers. A
//! message that goes to several keys below that of the topic has a different number at each.
//!
//! Sources: ros2/rmw_zenoh `docs/design.md`, `liveliness_utils.cpp`, `buffer_endpoint_helpers.hpp`, `rmw_publisher_data.cpp`;
//! zenoh-plugin-ros2dds `liveliness_mgt.rs`.

use conicflow_ros::Definition;
use conicflow_ros2::{Distro, End, Participant, Published, Via, Way};

/// Stands for an empty namespace or enclave.
const EMPTY: &str = "%";
/// Humble's placeholder for the hash of a type.
const NO_HASH: &str = "TypeHashNotSupported";
/// Part below the key of a topic at which subscribers without a memory backend get their messages.
const OF_NO_MEMORY: &str = "_buf_cpu";
/// Ends the token of a subscriber that takes messages at [`OF_NO_MEMORY`].
const NO_MEMORY: &str = "/backends:cpu:";
/// The number of our node in its session.
const NODE: usize = 0;

/// The Zenoh names of a participant.
pub(super) struct Keys<'a>(pub &'a Participant);

impl Keys<'_> {
    /// The key under which an endpoint publishes or subscribes. A subscriber accepts any hash of the type: messages themselves
    /// show whether we can decode them.
    pub(super) fn key(&self, End { topic, definition, way }: &End) -> String {
        let topic = topic.trim_matches('/');
        if self.0.via == Via::Ros2dds {
            return topic.to_owned();
        }
        let hash = if *way == Way::Publish { self.hash(definition) } else { "*".to_owned() };
        format!("{}/{topic}/{}/{hash}", self.0.domain, dds_name(definition.name))
    }

    /// All keys that an endpoint subscribes to.
    pub(super) fn keys_to_take(&self, end: &End) -> Vec<String> {
        let key = self.key(end);
        let below = self.takes_below(end).then(|| format!("{key}/{OF_NO_MEMORY}"));
        std::iter::once(key).chain(below).collect()
    }

    /// Whether messages for this endpoint may come below its key.
    fn takes_below(&self, End { definition, way, .. }: &End) -> bool {
        self.0.via == Via::RmwZenoh && matches!(way, Way::Subscribe(_)) && definition.text.contains("uint8[] ")
    }

    /// The tokens of the node and its endpoints; `zid` is the id of the session.
    pub(super) fn tokens(&self, zid: &str) -> Vec<String> {
        let Participant { domain, name, ends, .. } = self.0;
        if self.0.via == Via::Ros2dds {
            return ends.iter().map(|end| self.ros2dds_token(zid, end)).collect();
        }
        let node = format!("@ros2_lv/{domain}/{zid}/{NODE}");
        let ends = ends.iter().zip(NODE + 1..).map(|(end, number)| {
            let End { topic, definition, way } = end;
            let (topic, kind, hash) = (topic.replace('/', "%"), dds_name(definition.name), self.hash(definition));
            let (letters, quality) = (letters(*way), quality(*way));
            let memory = if self.takes_below(end) { NO_MEMORY } else { "" };
            format!("{node}/{number}/{letters}/{EMPTY}/{EMPTY}/{name}/{topic}/{kind}/{hash}/{quality}{memory}")
        });
        std::iter::once(format!("{node}/{NODE}/NN/{EMPTY}/{EMPTY}/{name}")).chain(ends).collect()
    }

    fn ros2dds_token(&self, zid: &str, End { topic, definition, way }: &End) -> String {
        let (topic, kind) = (topic.trim_matches('/').replace('/', "§"), definition.name.replace('/', "§"));
        // Keyless; 1 reliable or 0 best effort; 0 volatile or 1 transient local; history: keep the last 10.
        let quality = match way {
            Way::Publish => ":1:0:0,10",
            Way::Subscribe(_) => ":0:0:0,10",
            Way::SubscribeLatched(_) => ":1:1:0,10",
        };
        let user_data = match self.0.distro {
            Distro::Humble => String::new(),
            _ => format!(":typehash={};", self.hash(definition)),
        };
        format!("@/{zid}/@ros2_lv/{}/{topic}/{kind}/{quality}{user_data}", letters(*way))
    }

    /// A key expression that matches the tokens of all publishers.
    pub(super) fn tokens_of_publishers(&self) -> String {
        match self.0.via {
            Via::RmwZenoh => format!("@ros2_lv/{}/*/*/*/MP/**", self.0.domain),
            Via::Ros2dds => "@/*/@ros2_lv/MP/**".to_owned(),
        }
    }

    /// Returns the topic and type of a publisher's token.
    pub(super) fn published(&self, token: &str) -> Option<Published> {
        let parts: Vec<_> = token.split('/').collect();
        match (self.0.via, &parts[..]) {
            (Via::RmwZenoh, [_, _, _, _, _, "MP", _, _, _, topic, kind, ..]) => {
                Some((topic.replace('%', "/"), ros_name(kind)))
            }
            (Via::Ros2dds, ["@", _, "@ros2_lv", "MP", topic, kind, ..]) => {
                Some((format!("/{}", topic.replace('§', "/")), kind.replace('§', "/")))
            }
            _ => None,
        }
    }

    fn hash(&self, definition: &Definition) -> String {
        if self.0.distro == Distro::Humble { NO_HASH.to_owned() } else { format!("RIHS01_{}", definition.rihs01) }
    }
}

/// Whether a message with this key came below the key of its topic.
pub(super) fn comes_below(key: &str) -> bool {
    key.rsplit('/').next() == Some(OF_NO_MEMORY)
}

/// The key expression for querying the caches of publishers for earlier messages.
pub(super) fn key_of_caches(key: &str) -> String {
    format!("{key}/@adv/**")
}

fn letters(way: Way) -> &'static str {
    if way == Way::Publish { "MP" } else { "MS" }
}

/// The QoS of an endpoint: reliability, durability, depth, deadline, lifespan, liveliness; defaults are left empty. 2 stands for
/// best effort, 1 for transient local.
fn quality(way: Way) -> &'static str {
    match way {
        Way::Publish => "::,10:,:,:,,",
        Way::Subscribe(_) => "2::,10:,:,:,,",
        Way::SubscribeLatched(_) => ":1:,10:,:,:,,",
    }
}

/// Returns the DDS name of a type: `sensor_msgs::msg::dds_::Image_` for `sensor_msgs/msg/Image`.
fn dds_name(name: &str) -> String {
    let (package, kind) = name.rsplit_once('/').unwrap_or(("", name));
    format!("{}::dds_::{kind}_", package.replace('/', "::"))
}

/// Returns the ROS name of a DDS type.
fn ros_name(name: &str) -> String {
    name.replace("dds_::", "").replace("::", "/").trim_end_matches('_').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_ros::{DETECTION_ARRAY, IMAGE, TF_MESSAGE};
    use zenoh::key_expr::keyexpr;

    const ZID: &str = "1234567890abcdef1234567890abcdef";
    const DETECTIONS_HASH: &str = "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018";
    const IMAGE_HASH: &str = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47";

    fn end(topic: &str, definition: Definition, way: Way) -> End {
        End { topic: topic.to_owned(), definition, way }
    }

    fn participant(via: Via, distro: Distro) -> Participant {
        let ends = vec![
            end("/camera/depth/image", IMAGE, Way::Subscribe(4)),
            end("/tf_static", TF_MESSAGE, Way::SubscribeLatched(4)),
            end("/conicflow/tracks", DETECTION_ARRAY, Way::Publish),
        ];
        Participant { connect: Vec::new(), domain: 7, distro, via, name: "conicflow_ros".to_owned(), ends }
    }

    /// Whether the query for publishers matches this token.
    fn is_asked_for(keys: &Keys<'_>, token: &str) -> bool {
        keyexpr::new(&keys.tokens_of_publishers()).unwrap().includes(keyexpr::new(token).unwrap())
    }

    #[test]
    fn keys_and_tokens_are_those_of_rmw_zenoh() {
        let participant = participant(Via::RmwZenoh, Distro::Jazzy);
        let keys = Keys(&participant);
        let actual: Vec<_> = participant.ends.iter().map(|end| keys.key(end)).collect();
        let detections = "vision_msgs::msg::dds_::Detection3DArray_";
        assert_eq!(actual[0], "7/camera/depth/image/sensor_msgs::msg::dds_::Image_/*");
        assert_eq!(actual[1], "7/tf_static/tf2_msgs::msg::dds_::TFMessage_/*");
        assert_eq!(actual[2], format!("7/conicflow/tracks/{detections}/{DETECTIONS_HASH}"));
        let taken: Vec<_> = participant.ends[..2].iter().map(|end| keys.keys_to_take(end)).collect();
        assert_eq!(taken, [vec![actual[0].clone(), format!("{}/_buf_cpu", actual[0])], vec![actual[1].clone()]]);
        assert!(comes_below(&taken[0][1]) && !comes_below(&taken[0][0]));
        let node = format!("@ros2_lv/7/{ZID}/0");
        let tf = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087";
        let expected = [
            format!("{node}/0/NN/%/%/conicflow_ros"),
            format!(
                "{node}/1/MS/%/%/conicflow_ros/%camera%depth%image/sensor_msgs::msg::dds_::Image_/{IMAGE_HASH}/\
                 2::,10:,:,:,,/backends:cpu:"
            ),
            format!("{node}/2/MS/%/%/conicflow_ros/%tf_static/tf2_msgs::msg::dds_::TFMessage_/{tf}/:1:,10:,:,:,,"),
            format!("{node}/3/MP/%/%/conicflow_ros/%conicflow%tracks/{detections}/{DETECTIONS_HASH}/::,10:,:,:,,"),
        ];
        assert_eq!(keys.tokens(ZID), expected);
        let published = ("/conicflow/tracks".to_owned(), DETECTION_ARRAY.name.to_owned());
        assert_eq!(keys.published(&expected[3]), Some(published));
        assert_eq!(expected[..3].iter().find_map(|token| keys.published(token)), None);
        assert_eq!(expected.each_ref().map(|token| is_asked_for(&keys, token)), [false, false, false, true]);
    }

    #[test]
    fn only_a_subscriber_over_rmw_zenoh_takes_messages_below_its_key() {
        let takes_below = |via, way| {
            let participant = participant(via, Distro::Jazzy);
            Keys(&participant).takes_below(&end("/camera/depth/image", IMAGE, way))
        };
        assert!(takes_below(Via::RmwZenoh, Way::Subscribe(4)));
        assert!(!takes_below(Via::RmwZenoh, Way::Publish) && !takes_below(Via::Ros2dds, Way::Subscribe(4)));
    }

    #[test]
    fn caches_answer_below_the_key_of_their_topic() {
        assert_eq!(key_of_caches("7/tf_static/type/hash"), "7/tf_static/type/hash/@adv/**");
    }

    #[test]
    fn humble_has_no_type_hashes() {
        let participant = participant(Via::RmwZenoh, Distro::Humble);
        let key = Keys(&participant).key(&participant.ends[2]);
        assert_eq!(key, "7/conicflow/tracks/vision_msgs::msg::dds_::Detection3DArray_/TypeHashNotSupported");
        let tokens = Keys(&participant).tokens(ZID);
        assert!(tokens[1..].iter().all(|token| token.contains("_/TypeHashNotSupported/")), "{tokens:?}");
    }

    #[test]
    fn keys_and_tokens_are_those_of_ros2dds() {
        let participant = participant(Via::Ros2dds, Distro::Humble);
        let keys = Keys(&participant);
        let actual: Vec<_> = participant.ends.iter().map(|end| keys.key(end)).collect();
        assert_eq!(actual, ["camera/depth/image", "tf_static", "conicflow/tracks"]);
        let expected = [
            format!("@/{ZID}/@ros2_lv/MS/camera§depth§image/sensor_msgs§msg§Image/:0:0:0,10"),
            format!("@/{ZID}/@ros2_lv/MS/tf_static/tf2_msgs§msg§TFMessage/:1:1:0,10"),
            format!("@/{ZID}/@ros2_lv/MP/conicflow§tracks/vision_msgs§msg§Detection3DArray/:1:0:0,10"),
        ];
        assert_eq!(keys.tokens(ZID), expected);
        let published = ("/conicflow/tracks".to_owned(), DETECTION_ARRAY.name.to_owned());
        assert_eq!(keys.published(&expected[2]), Some(published));
        assert_eq!(expected.each_ref().map(|token| is_asked_for(&keys, token)), [false, false, true]);
        let newer = Participant { distro: Distro::Kilted, ..participant.clone() };
        assert!(Keys(&newer).tokens(ZID)[0].ends_with(&format!("/:0:0:0,10:typehash={IMAGE_HASH};")));
    }
}
