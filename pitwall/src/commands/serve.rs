//! `pitwall`: the page.

use std::process::ExitCode;

use pitwall::{PageOptions, PitWall, Role, WallOptions};
use serde_json::json;

use super::interrupted;
use crate::cli::{LinkOptions, Page};
use crate::output;

pub(super) async fn run(link: &LinkOptions, page: Page, json: bool) -> anyhow::Result<ExitCode> {
    let role = Role::choose(&link.listen, &link.connect);
    let how = role.to_string();
    let page = PageOptions {
        address: page.page,
        recordings: page.recordings,
    };
    let wall = PitWall::start(WallOptions { role, page }).await?;
    if json {
        output::say_json(&json!({"page": wall.url(), "link": how}))?;
    } else {
        output::say(&format!("pit wall: {}\n{how}; Ctrl-C ends it", wall.url()));
    }
    interrupted().await;
    wall.stop().await;
    Ok(ExitCode::SUCCESS)
}
