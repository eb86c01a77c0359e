//! What other nodes announce: their publishers, by `rmw_zenoh`'s liveliness tokens. Announced topics that send nothing may wait
//! for a subscriber, so this node announces one. Topics of other domains are the hint that the domain is wrong.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

use zenoh::handlers::Callback;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::choice::listed;
use super::topics::Kind;
use crate::ros2::graph::{NODE, token_of_subscriber};

/// More tokens are not kept.
const MOST_TOKENS: usize = 4096;

/// A publisher of another node.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct AnnouncedTopic {
    pub(super) domain: u32,
    /// The ROS name.
    pub(super) topic: String,
    /// The type, as keys spell it.
    pub(super) dds: String,
    pub(super) hash: String,
}

/// Reads the token of a publisher; None for any other token.
fn parse(token: &str) -> Option<AnnouncedTopic> {
    let mut parts = token.split('/');
    if parts.next() != Some("@ros2_lv") {
        return None;
    }
    let domain = parts.next()?.parse().ok()?;
    if parts.nth(3)? != "MP" {
        return None;
    }
    let topic = parts.nth(3)?.replace('%', "/");
    Some(AnnouncedTopic {
        domain,
        topic,
        dds: parts.next()?.to_owned(),
        hash: parts.next()?.to_owned(),
    })
}

type Announced = Arc<Mutex<BTreeMap<String, AnnouncedTopic>>>;

/// The publishers that other nodes announce.
pub(super) struct RosGraph {
    session: Session,
    announced: Announced,
    /// Subscribers that this node announces, by topic.
    subscribed: BTreeMap<AnnouncedTopic, Option<LivelinessToken>>,
    /// Subscribers announced so far.
    number: usize,
    _subscriber: Subscriber<()>,
}

impl RosGraph {
    pub(super) fn watch(session: &Session) -> zenoh::Result<Self> {
        let announced = Announced::default();
        let own = format!("/{}/", session.zid());
        let callback = Callback::from({
            let announced = Arc::clone(&announced);
            move |sample: Sample| {
                let token = sample.key_expr().as_str();
                if token.contains(&own) {
                    return;
                }
                let mut announced = announced.lock().unwrap_or_else(PoisonError::into_inner);
                if sample.kind() == SampleKind::Delete {
                    announced.remove(token);
                } else if let Some(topic) = parse(token)
                    && announced.len() < MOST_TOKENS
                {
                    announced.insert(token.to_owned(), topic);
                }
            }
        });
        let subscriber = session
            .liveliness()
            .declare_subscriber("@ros2_lv/**")
            .history(true)
            .with(callback)
            .wait()?;
        Ok(Self {
            session: session.clone(),
            announced,
            subscribed: BTreeMap::new(),
            number: 0,
            _subscriber: subscriber,
        })
    }

    fn topics(&self) -> BTreeSet<AnnouncedTopic> {
        let announced = self.announced.lock().unwrap_or_else(PoisonError::into_inner);
        announced.values().cloned().collect()
    }

    /// The topics of a kind that are announced in a domain.
    pub(super) fn announced(&self, kind: Kind, domain: u32) -> Vec<String> {
        let wanted = |topic: &AnnouncedTopic| topic.domain == domain && topic.dds == kind.ros_type().dds;
        let mut topics: Vec<_> = self
            .topics()
            .into_iter()
            .filter(wanted)
            .map(|topic| topic.topic)
            .collect();
        topics.dedup();
        topics
    }

    /// Announces a subscriber for each topic that passes `wanted`, and withdraws the others.
    pub(super) fn subscribe(&mut self, domain: u32, namespace: &str, wanted: impl Fn(Kind, &str) -> bool) {
        let topics: BTreeSet<_> = self
            .topics()
            .into_iter()
            .filter(|topic| {
                topic.domain == domain
                    && Kind::of_type(&topic.dds).is_some_and(|kind| wanted(kind, &topic.topic))
            })
            .collect();
        self.subscribed.retain(|topic, _| topics.contains(topic));
        for topic in topics {
            let (session, number) = (&self.session, &mut self.number);
            self.subscribed.entry(topic).or_insert_with_key(|topic| {
                *number += 1;
                let token = token_of_subscriber(
                    session,
                    (topic.domain, namespace, *number),
                    &topic.topic,
                    &topic.dds,
                    &topic.hash,
                );
                match session.liveliness().declare_token(token).wait() {
                    Ok(token) => Some(token),
                    Err(error) => {
                        tracing::debug!(%error, topic = topic.topic, "{NODE}: a subscriber is not announced");
                        None
                    }
                }
            });
        }
    }

    /// Announces the subscribers anew, in another namespace.
    pub(super) fn rename(&mut self, domain: u32, namespace: &str, wanted: impl Fn(Kind, &str) -> bool) {
        let before = std::mem::take(&mut self.subscribed);
        self.subscribe(domain, namespace, wanted);
        // Publishers that wait for subscribers see no moment without one.
        drop(before);
    }

    /// Where else there are scans and odometry, for people; None when nowhere.
    pub(super) fn other_domains(&self, domain: u32) -> Option<String> {
        let mut domains: BTreeMap<u32, Vec<String>> = BTreeMap::new();
        for topic in self.topics() {
            if topic.domain != domain
                && matches!(Kind::of_type(&topic.dds), Some(Kind::Scan | Kind::Odometry))
            {
                let topics = domains.entry(topic.domain).or_default();
                if !topics.contains(&topic.topic) {
                    topics.push(topic.topic);
                }
            }
        }
        let texts: Vec<String> = domains
            .iter()
            .take(3)
            .map(|(domain, topics)| format!("domain {domain} has {} (--ros-domain {domain})", listed(topics)))
            .collect();
        (!texts.is_empty()).then(|| texts.join("; "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_token_of_a_publisher_names_its_topic() {
        let token = "@ros2_lv/7/aa11/0/3/MP/%/%car1/lidar/%car1%scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_64/2::,5:,:,:,,";
        let topic = parse(token).expect("a publisher");
        assert_eq!((topic.domain, topic.topic.as_str()), (7, "/car1/scan"));
        assert_eq!(Kind::of_type(&topic.dds), Some(Kind::Scan));
        assert_eq!(topic.hash, "RIHS01_64");
        for other in [
            "@ros2_lv/7/aa11/0/0/NN/%/%/lidar",
            &token.replace("/MP/", "/MS/"),
            "@ros2_lv/x/aa11/0/3/MP/%/%/lidar/%scan/t/h/q",
            "@ros2_lv",
            "",
        ] {
            assert_eq!(parse(other), None, "{other}");
        }
    }
}
