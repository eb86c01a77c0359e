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
    let options = PageOptions {
        address: page.address,
        recordings: page.recordings.clone(),
    };
    let wall = PitWall::start(WallOptions { role, page: options }).await?;
    #[cfg(feature = "rerun")]
    let views = rerun_views(&wall, &page)?;
    if json {
        output::say_json(&json!({"page": wall.url(), "link": how}))?;
    } else {
        output::say(&format!("pit wall: {}\n{how}; Ctrl-C ends it", wall.url()));
    }
    interrupted().await;
    #[cfg(feature = "rerun")]
    views.into_iter().for_each(pitwall::RerunView::finish);
    wall.stop().await;
    Ok(ExitCode::SUCCESS)
}

/// The views for Rerun that were asked for.
#[cfg(feature = "rerun")]
fn rerun_views(wall: &PitWall, page: &Page) -> anyhow::Result<Vec<pitwall::RerunView>> {
    use pitwall::{RerunOutlet, RerunView};
    let save = page.rerun_save.clone().map(RerunOutlet::Save);
    let connect = page.rerun_connect.clone().map(RerunOutlet::Connect);
    let start = |outlet| RerunView::start(wall.hub().tap(), &outlet);
    Ok(save
        .into_iter()
        .chain(connect)
        .map(start)
        .collect::<Result<_, _>>()?)
}
