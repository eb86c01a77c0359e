//! The Rerun viewer in a pane of the page. It starts on the first request and is served from the page's own origin.

use std::net::TcpListener;
use std::sync::OnceLock;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use re_web_viewer_server::WebViewerData;
use serde_json::json;

use super::App;
use crate::rerun::{RerunOutlet, RerunView};

/// The running data server.
pub(super) struct Pane {
    /// Stops when it is dropped.
    _view: RerunView,
    port: u16,
}

/// The viewer's files.
static VIEWER: OnceLock<Option<WebViewerData>> = OnceLock::new();

/// Starts the data server if it does not run yet, and returns the URL of the pane.
pub(super) async fn open(State(app): State<App>) -> Response {
    let mut pane = app.pane.lock().await;
    if pane.is_none() {
        let started = free_port().map_err(|error| error.to_string()).and_then(|port| {
            let view = RerunView::start(app.bus.subscribe(app.now()), &RerunOutlet::Serve(port))
                .map_err(|e| e.to_string())?;
            Ok(Pane { _view: view, port })
        });
        match started {
            Ok(started) => *pane = Some(started),
            Err(error) => return (StatusCode::INTERNAL_SERVER_ERROR, error).into_response(),
        }
    }
    let port = pane.as_ref().map_or(0, |pane| pane.port);
    // The viewer reads its source from its own address.
    let source = format!("rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port}%2Fproxy");
    Json(json!({"url": format!("/rerun/index.html?hide_welcome_screen&url={source}")})).into_response()
}

/// One of the viewer's files. The viewer may only load itself and connect to the data server, because by default it
/// connects to an analytics host.
pub(super) async fn file(State(app): State<App>, Path(name): Path<String>) -> Response {
    let Some(viewer) = VIEWER.get_or_init(|| WebViewerData::load(None).ok()) else {
        return (StatusCode::NOT_FOUND, "this program was built without the viewer").into_response();
    };
    let (kind, content) = match name.as_str() {
        "index.html" => ("text/html", without_foreign_fonts(viewer.index_html())),
        "favicon.ico" => ("image/x-icon", viewer.favicon().to_vec()),
        "apple-touch-icon.png" => ("image/png", viewer.apple_touch_icon().to_vec()),
        "sw.js" => ("text/javascript", viewer.sw_js().to_vec()),
        "re_viewer.js" => ("text/javascript", viewer.viewer_js().to_vec()),
        "re_viewer_bg.wasm" => ("application/wasm", viewer.viewer_wasm().to_vec()),
        _ => return StatusCode::NOT_FOUND.into_response(),
    };
    let port = app.pane.lock().await.as_ref().map_or(0, |pane| pane.port);
    let policy = format!(
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; \
         img-src 'self' data: blob:; connect-src 'self' data: blob: http://127.0.0.1:{port}; frame-ancestors 'self'"
    );
    let mut response = ([(header::CONTENT_TYPE, kind)], content).into_response();
    if let Ok(policy) = HeaderValue::from_str(&policy) {
        response
            .headers_mut()
            .insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    response
}

/// The viewer's page without the links to a font on another host.
fn without_foreign_fonts(page: &[u8]) -> Vec<u8> {
    let page = String::from_utf8_lossy(page);
    let mut kept = String::with_capacity(page.len());
    let mut rest = &*page;
    while let Some(begin) = rest.find("<link") {
        let end = rest[begin..].find('>').map_or(rest.len(), |end| begin + end + 1);
        kept.push_str(&rest[..begin]);
        let link = &rest[begin..end];
        if !link.contains("https://") {
            kept.push_str(link);
        }
        rest = &rest[end..];
    }
    kept.push_str(rest);
    kept.into_bytes()
}

/// A port on loopback that is free now.
fn free_port() -> std::io::Result<u16> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.port())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_links_to_others_are_dropped() {
        let page = br#"<a><link rel="icon" href="favicon.ico" /><link
            href="https://fonts.example/x" />b<link"#;
        let kept = without_foreign_fonts(page);
        assert_eq!(
            String::from_utf8_lossy(&kept),
            r#"<a><link rel="icon" href="favicon.ico" />b<link"#
        );
    }
}
