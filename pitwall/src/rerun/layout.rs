//! The initial layout of the Rerun viewer: the track from above, lanes for state and set, plots, and the log.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::{CarName, MapReply};
use rerun::blueprint::components::{PanelState, PlayState};
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Horizontal, SelectionPanel, Spatial3DView,
    StateTimelineView, Tabs, TextLogView, TimePanel, TimeSeriesView, Vertical,
};
use rerun::external::re_sdk_types::blueprint::archetypes::EyeControls3D;
use rerun::log::LogMsg;
use rerun::{Points3D, RecordingStream, RecordingStreamBuilder, RecordingStreamError};

use crate::event::{EventPayload, FleetEvent};

/// The curves of each car, with their titles.
pub(super) const CURVES: [(&str, &str); 6] = [
    ("alignment", "alignment"),
    ("slip", "slip"),
    ("spread_along", "spread along [m]"),
    ("spread_across", "spread across [m]"),
    ("speed", "speed [m/s]"),
    ("update_ms", "update p99 [ms]"),
];

/// Where a curve of a car is logged.
pub(super) fn curve(what: &str, car: &CarName) -> String {
    format!("plots/{what}/{car}")
}

/// Waits until the layout can be made. It is sent once, because a second one would undo the changes of the user.
#[derive(Default)]
pub(super) struct Layout {
    map: Option<Arc<MapReply>>,
    cars: BTreeSet<CarName>,
    /// When the first car appeared \[unix ns\].
    since: Option<i64>,
    sent: bool,
}

impl Layout {
    /// Time after the first car within which the others appear and a map is fetched \[ns\].
    const WAIT: i64 = 1_500_000_000;
    /// Maximum time to wait for a map \[ns\].
    const MAPLESS: i64 = 10_000_000_000;

    /// Adds an event; returns the layout when it is due.
    pub(super) fn learn(&mut self, event: &FleetEvent) -> Option<Plan> {
        if self.sent {
            return None;
        }
        self.cars.insert(event.car.clone());
        if let (None, EventPayload::Map { map, .. }) = (&self.map, &event.payload) {
            self.map = Some(map.clone());
        }
        let waited = event.at - *self.since.get_or_insert(event.at);
        if waited > Self::MAPLESS || (waited > Self::WAIT && self.map.is_some()) {
            return self.settle();
        }
        None
    }

    /// The layout as far as it is known, if it was not returned before.
    pub(super) fn settle(&mut self) -> Option<Plan> {
        if self.sent || self.cars.is_empty() {
            return None;
        }
        self.sent = true;
        Some(Plan {
            map: self.map.take(),
            cars: std::mem::take(&mut self.cars).into_iter().collect(),
        })
    }
}

/// The content of the layout.
pub(super) struct Plan {
    map: Option<Arc<MapReply>>,
    cars: Vec<CarName>,
}

impl Plan {
    /// Sends the layout.
    pub(super) fn send(&self, stream: &RecordingStream) -> Result<(), RecordingStreamError> {
        // It goes through memory, because the path of its 3-D view is needed for the camera and the view has no setter for
        // that.
        let (scratch, drawn) = RecordingStreamBuilder::new("pitwall").memory()?;
        let activation = BlueprintActivation {
            make_active: true,
            make_default: true,
        };
        blueprint(&self.cars).send(&scratch, activation)?;
        scratch.flush_blocking().ok();
        let mut messages: Vec<LogMsg> = drawn.take();
        messages.retain(|message| message.store_id().is_blueprint());
        let view = messages.iter().find_map(view_with_defaults);
        let store = messages.first().map(|message| message.store_id().clone());
        let camera = match (view, store, &self.map) {
            (Some(view), Some(store), Some(map)) => {
                let (eye, seen) = RecordingStreamBuilder::from_store_id(&store).memory()?;
                eye.set_time_sequence("blueprint", 0);
                eye.log(format!("{view}/EyeControls3D"), &from_above(map))?;
                eye.flush_blocking().ok();
                seen.take()
            }
            _ => Vec::new(),
        };
        // The first message of the layout announces its store, the last one activates it.
        let activate = messages.pop();
        let camera = camera
            .into_iter()
            .filter(|message| matches!(message, LogMsg::ArrowMsg(..)));
        for message in messages.into_iter().chain(camera).chain(activate) {
            stream.record_msg(message);
        }
        Ok(())
    }
}

/// The path of the view with defaults, which only the track has.
fn view_with_defaults(message: &LogMsg) -> Option<String> {
    let LogMsg::ArrowMsg(_, arrow) = message else {
        return None;
    };
    let schema = arrow.batch.schema();
    let path = schema.metadata().get("rerun:entity_path")?;
    Some(path.strip_suffix("/defaults")?.to_owned())
}

/// A camera above the middle of the raceline, or else of the map, high enough to see all of it.
fn from_above(map: &MapReply) -> EyeControls3D {
    let points: Vec<[f64; 2]> = if let Some(line) = &map.raceline {
        let point = |&[x, y]: &[f32; 2]| [f64::from(x), f64::from(y)];
        line.points.iter().map(point).collect()
    } else {
        let (sin, cos) = map.origin.heading.sin_cos();
        let (w, h) = (
            f64::from(map.width) * map.resolution,
            f64::from(map.height) * map.resolution,
        );
        let corner = |[u, v]: [f64; 2]| [map.origin.x + cos * u - sin * v, map.origin.y + sin * u + cos * v];
        [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]].map(corner).into()
    };
    let range = |i: usize| {
        points
            .iter()
            .map(|p| p[i])
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| {
                (a.min(v), b.max(v))
            })
    };
    let ((left, right), (low, high)) = (range(0), range(1));
    let middle = [f64::midpoint(left, right), f64::midpoint(low, high)];
    let height = (right - left).max(high - low) * 1.1 + 4.0;
    let at = |z: f64| [middle[0] as f32, middle[1] as f32, z as f32];
    EyeControls3D::new()
        .with_position(at(height))
        .with_look_target(at(0.0))
        .with_eye_up([0.0, 1.0, 0.0])
}

fn blueprint(cars: &[CarName]) -> Blueprint {
    let lanes = |contents: Vec<String>| StateTimelineView::new("state and set").with_contents(contents);
    let curves = |which: &[usize]| -> Vec<ContainerLike> {
        let of_all = |&i: &usize| {
            let (what, title) = CURVES[i];
            TimeSeriesView::new(title)
                .with_contents([format!("/plots/{what}/**")])
                .into()
        };
        which.iter().map(of_all).collect()
    };
    let events = TextLogView::new("events").with_contents(["/events/**"]);
    let mut all: Vec<ContainerLike> = vec![lanes(vec!["/lanes/**".into()]).into()];
    all.extend(curves(&[0, 1, 2]));
    all.push(events.into());
    let mut tabs: Vec<ContainerLike> = vec![
        Vertical::new(all)
            .with_name("all cars")
            .with_row_shares([3.0, 2.0, 2.0, 2.0, 2.0])
            .into(),
    ];
    for car in cars {
        let mut own: Vec<ContainerLike> = vec![lanes(vec![format!("/lanes/{car}/**")]).into()];
        own.extend(CURVES.iter().map(|(what, title)| {
            let contents = format!("/{}", curve(what, car));
            TimeSeriesView::new(*title).with_contents([contents]).into()
        }));
        tabs.push(Vertical::new(own).with_name(car.to_string()).into());
    }
    let track = Spatial3DView::new("track")
        .with_origin("/track")
        .with_defaults(&Points3D::update_fields().with_radii([0.02]));
    let root = Horizontal::new([track.into(), Tabs::new(tabs).into()]).with_column_shares([3.0, 2.0]);
    Blueprint::new(root)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(
            TimePanel::new()
                .with_state(PanelState::Collapsed)
                .with_timeline("time")
                .with_play_state(PlayState::Following),
        )
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Cell, MapRaceline, Pose2};
    use rerun::external::re_log_types::EntityPathFilter;

    fn map() -> Arc<MapReply> {
        Arc::new(MapReply {
            name: "m".into(),
            width: 2,
            height: 1,
            resolution: 1.0,
            origin: Pose2::default(),
            runs: MapReply::pack([Cell::Free, Cell::Occupied]),
            raceline: Some(MapRaceline {
                length: 40.0,
                points: vec![[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]],
            }),
        })
    }

    fn event(car: &str, at: i64, payload: EventPayload) -> FleetEvent {
        FleetEvent {
            at,
            car: car.parse().expect("a name"),
            payload,
        }
    }

    fn with_map() -> EventPayload {
        EventPayload::Map {
            map: map(),
            bytes: Arc::default(),
        }
    }

    #[test]
    fn the_layout_is_made_once_with_the_cars_that_are_there() {
        let second = 1_000_000_000;
        let mut layout = Layout::default();
        assert!(layout.settle().is_none(), "there is no car yet");
        assert!(layout.learn(&event("car-2", 0, EventPayload::Appeared)).is_none());
        assert!(layout.learn(&event("car-1", second, with_map())).is_none());
        let plan = layout.learn(&event("car-2", 2 * second, EventPayload::Appeared));
        let plan = plan.expect("a map and time enough");
        assert_eq!(
            plan.cars.iter().map(CarName::as_str).collect::<Vec<_>>(),
            ["car-1", "car-2"]
        );
        assert!(layout.learn(&event("car-3", 60 * second, with_map())).is_none());
        assert!(layout.settle().is_none());
    }

    #[test]
    fn without_a_map_there_is_a_layout_in_the_end() {
        let mut layout = Layout::default();
        assert!(layout.learn(&event("car-1", 0, EventPayload::Appeared)).is_none());
        let late = event("car-1", Layout::MAPLESS + 1, EventPayload::Vanished);
        assert!(layout.learn(&late).is_some_and(|plan| plan.map.is_none()));
    }

    #[test]
    fn a_session_that_ends_early_has_a_layout() {
        let mut layout = Layout::default();
        assert!(layout.learn(&event("car-1", 0, with_map())).is_none());
        assert!(layout.settle().is_some_and(|plan| plan.map.is_some()));
    }

    /// Where a chunk goes, and what is in it.
    fn chunks(messages: &[LogMsg]) -> Vec<(String, String)> {
        messages
            .iter()
            .filter_map(|message| match message {
                LogMsg::ArrowMsg(_, arrow) => Some((
                    arrow.batch.schema().metadata().get("rerun:entity_path")?.clone(),
                    format!("{:?}", arrow.batch),
                )),
                _ => None,
            })
            .collect()
    }

    #[test]
    fn the_layout_has_its_camera_over_the_track_and_finds_every_curve() {
        let (stream, stored) = RecordingStreamBuilder::new("pitwall").memory().expect("a stream");
        let cars = ["car-1", "car-2"].map(|name| name.parse().expect("a name"));
        let plan = Plan {
            map: Some(map()),
            cars: cars.to_vec(),
        };
        plan.send(&stream).expect("sent");
        stream.flush_blocking().expect("flushed");
        let messages = stored.take();
        let activated = matches!(messages.last(), Some(LogMsg::BlueprintActivationCommand(_)));
        assert!(activated, "the last message activates what has come");

        let chunks = chunks(&messages);
        let camera: Vec<_> = chunks
            .iter()
            .filter(|(path, _)| path.ends_with("/EyeControls3D"))
            .collect();
        assert_eq!(camera.len(), 1);
        // The middle of the raceline.
        assert!(camera[0].1.contains("5.0"), "{}", camera[0].1);

        // A viewer accepts wildcards only at the end of a path. Elsewhere they match nothing, without an error.
        let queries: Vec<String> = chunks
            .iter()
            .filter(|(path, _)| path.ends_with("/ViewContents"))
            .flat_map(|(_, batch)| {
                batch
                    .split('"')
                    .filter(|text| text.starts_with('/') && !text.starts_with("/view/"))
                    .map(str::to_owned)
                    .collect::<Vec<_>>()
            })
            .collect();
        for query in &queries {
            assert!(!query.trim_end_matches("/**").contains('*'), "{query}");
        }
        for (what, _) in CURVES {
            for car in &cars {
                let path = rerun::EntityPath::from(curve(what, car));
                let shown = queries
                    .iter()
                    .filter_map(|query| EntityPathFilter::parse_strict(query).ok())
                    .filter(|query| query.clone().resolve_without_substitutions().matches(&path))
                    .count();
                assert!(shown > 0, "{path} is in none of {queries:?}");
            }
        }
    }
}
