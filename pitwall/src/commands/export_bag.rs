//! `pitwall export --bag`: a ROS 2 bag for each car.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use pitwall::{EventPayload, RosBag, UnreadableCount};
use protocol::{CarName, Pose2, Topic};
use serde_json::json;

use crate::output;

/// The topics that ROS has types for.
fn wanted(topic: Topic) -> bool {
    topic.recorded() && topic != Topic::RecordedHealth || topic == Topic::Pose
}

/// A car's bag; None while it has no message.
type Bags = BTreeMap<CarName, (Option<Pose2>, Option<RosBag>)>;

pub(super) fn run(file: &Path, folder: Option<PathBuf>, json: bool) -> anyhow::Result<ExitCode> {
    let folder = folder.unwrap_or_else(|| file.with_extension("bags"));
    let events = super::export::events_for(file, &folder, wanted)?;
    let mut bags = Bags::new();
    let mut unreadable = UnreadableCount::default();
    for event in events {
        let event = event?;
        unreadable.add(&event);
        let (mount, bag) = bags.entry(event.car.clone()).or_default();
        match &event.payload {
            EventPayload::Info(info) => {
                let laser = info.base_link_from_laser;
                if mount.replace(laser) != Some(laser)
                    && let Some(bag) = bag
                {
                    bag.set_mount(laser);
                }
            }
            EventPayload::Message {
                header, telemetry, ..
            } => {
                let place = folder.join(event.car.as_str());
                let failed = || place.display().to_string();
                if bag.is_none() {
                    fs::create_dir_all(&place).with_context(failed)?;
                    let mut new = RosBag::create(&place, event.car.as_str()).with_context(failed)?;
                    if let Some(mount) = *mount {
                        new.set_mount(mount);
                    }
                    *bag = Some(new);
                }
                if let Some(bag) = bag {
                    bag.add(header, telemetry).with_context(failed)?;
                }
            }
            _ => {}
        }
    }
    let mut written = BTreeMap::new();
    for (car, (_, bag)) in bags {
        if let Some(bag) = bag {
            let place = folder.join(car.as_str());
            let messages = bag.finish(&place).with_context(|| place.display().to_string())?;
            written.insert(place.display().to_string(), messages);
        }
    }
    let unreadable = unreadable.list();
    super::print_unreadable(&unreadable);
    if json {
        output::print_json(&json!({"bags": written, "unreadable": unreadable}))?;
    } else {
        for (bag, messages) in &written {
            output::print(&format!("{bag}: {messages} messages"));
        }
    }
    Ok(ExitCode::SUCCESS)
}
