//! A headless Chromium, driven through its driver.

use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fantoccini::actions::{InputSource, MOUSE_BUTTON_LEFT, MouseActions, PointerAction};
use fantoccini::wd::WebDriverCompatibleCommand;
use fantoccini::{Client, ClientBuilder, Locator};
use hyper_util::client::legacy::connect::HttpConnector;
use serde_json::{Value, json};

/// How long the browser may take: starting it on a busy machine without a graphics card does take its time.
const PATIENCE: Duration = Duration::from_secs(90);

/// A browser with one page. Dropping it ends it.
pub struct Browser {
    client: Client,
    driver: Child,
    _profile: tempfile::TempDir,
}

impl Browser {
    /// Opens `url` in a fresh browser whose page is `width` times `height` pixels large, and keeps a log of its console
    /// and of every request.
    pub async fn open(url: &str, width: u32, height: u32) -> Self {
        Self::start(
            url,
            width,
            height,
            json!({"browser": "ALL", "performance": "ALL"}),
        )
        .await
    }

    /// The same without a log: that of the network repeats every snapshot, which a measurement would measure.
    pub async fn open_unwatched(url: &str, width: u32, height: u32) -> Self {
        Self::start(url, width, height, json!({})).await
    }

    async fn start(url: &str, width: u32, height: u32, logs: Value) -> Self {
        let port = crate::free_endpoint()
            .rsplit_once(':')
            .map(|(_, port)| port.to_owned())
            .expect("a port");
        // A process group of its own: what the driver starts must not outlive the test.
        let driver = Command::new("chromedriver")
            .arg(format!("--port={port}"))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()
            .expect("chromedriver, from Debian's chromium-driver");
        let profile = tempfile::tempdir().expect("a folder");
        let mut arguments: Vec<String> = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--disable-dev-shm-usage",
        ]
        .map(str::to_owned)
        .into();
        arguments.push(format!("--user-data-dir={}", profile.path().display()));
        let capabilities = json!({
            "goog:chromeOptions": {"args": arguments},
            "goog:loggingPrefs": logs,
        });
        let mut builder = ClientBuilder::new(HttpConnector::new());
        builder.capabilities(capabilities.as_object().cloned().expect("an object"));
        let driver_url = format!("http://127.0.0.1:{port}");
        let deadline = Instant::now() + PATIENCE;
        let client = loop {
            match builder.connect(&driver_url).await {
                Ok(client) => break client,
                Err(error) => assert!(Instant::now() < deadline, "no browser: {error}"),
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        };
        let browser = Self {
            client,
            driver,
            _profile: profile,
        };
        browser.resize(width, height).await;
        browser.client.goto(url).await.expect("the page");
        browser
    }

    /// Makes the page `width` times `height` pixels large.
    pub async fn resize(&self, width: u32, height: u32) {
        let metrics = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": false});
        self.own(
            "goog/cdp/execute",
            json!({"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics}),
        )
        .await;
    }

    /// Runs `return SCRIPT` on the page.
    pub async fn ask(&self, script: &str) -> Value {
        self.client
            .execute(&format!("return {script}"), Vec::new())
            .await
            .unwrap_or_else(|error| panic!("{script}: {error}"))
    }

    /// Waits until the script gives something other than null, false, 0 and "", and returns that.
    pub async fn wait(&self, what: &str, script: &str) -> Value {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let value = self.ask(&format!("({script}) || null")).await;
            if !value.is_null() {
                return value;
            }
            if Instant::now() >= deadline {
                let cards = self
                    .ask("[...document.querySelectorAll('.card')].map((c) => c.innerText)")
                    .await;
                panic!("not within {PATIENCE:?}: {what}\n{script}\nthe cards say {cards:#}");
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Clicks what `css` finds.
    pub async fn click(&self, css: &str) {
        let element = self.client.find(Locator::Css(css)).await;
        let element = element.unwrap_or_else(|error| panic!("{css}: {error}"));
        element
            .click()
            .await
            .unwrap_or_else(|error| panic!("click on {css}: {error}"));
    }

    /// Types into what `css` finds, in place of what is there.
    pub async fn fill(&self, css: &str, text: &str) {
        let element = self.client.find(Locator::Css(css)).await;
        let element = element.unwrap_or_else(|error| panic!("{css}: {error}"));
        // The driver's own clearing counts as a change of its own.
        let empty = format!("(document.querySelector('{css}').value = '')");
        self.ask(&empty).await;
        element.send_keys(&format!("{text}\n")).await.expect("typed");
    }

    /// Types a key on the page.
    pub async fn key(&self, key: &str) {
        let event = format!("new KeyboardEvent('keydown', {{key: '{key}', bubbles: true}})");
        self.ask(&format!("document.body.dispatchEvent({event})")).await;
    }

    /// Presses at one point of the page, moves to another and lets go \[px\].
    pub async fn drag(&self, from: [f64; 2], to: [f64; 2]) {
        let move_to = |[x, y]: [f64; 2]| PointerAction::MoveTo {
            duration: Some(Duration::from_millis(50)),
            x: x.round(),
            y: y.round(),
        };
        let drag = MouseActions::new("mouse".into())
            .then(move_to(from))
            .then(PointerAction::Down {
                button: MOUSE_BUTTON_LEFT,
            })
            .then(move_to(to))
            .then(PointerAction::Up {
                button: MOUSE_BUTTON_LEFT,
            });
        self.client.perform_actions(drag).await.expect("dragged");
    }

    /// Keeps a picture of the page.
    pub async fn picture(&self, name: &str) -> PathBuf {
        let folder = std::env::var_os("PITWALL_CI_OUTPUT").map_or_else(std::env::temp_dir, PathBuf::from);
        std::fs::create_dir_all(&folder).expect("a folder for pictures");
        let png = self.client.screenshot().await.expect("a picture");
        let file = folder.join(format!("{name}.png"));
        std::fs::write(&file, png).expect("written");
        file
    }

    /// Fails if the console has an error or a warning, or the page asked anybody but `origin` for anything.
    pub async fn expect_clean(&self, origin: &str) {
        let console = self.log("browser").await;
        let bad = |entry: &&Value| entry["level"] == "SEVERE" || entry["level"] == "WARNING";
        let bad: Vec<_> = console.iter().filter(bad).collect();
        assert!(bad.is_empty(), "the console says {bad:#?}");
        let mut own = 0;
        for entry in self.log("performance").await {
            let text = entry["message"].as_str().unwrap_or_default();
            let event: Value = serde_json::from_str(text).unwrap_or_default();
            let params = &event["message"]["params"];
            let url = match event["message"]["method"].as_str() {
                Some("Network.requestWillBeSent") => &params["request"]["url"],
                Some("Network.webSocketCreated") => &params["url"],
                _ => continue,
            };
            let url = url.as_str().unwrap_or_default();
            // What the browser's own empty tab asks for is not the page's doing.
            if params["documentURL"]
                .as_str()
                .is_some_and(|page| page.starts_with("chrome"))
            {
                continue;
            }
            let local = ["data:", "blob:", "about:"]
                .iter()
                .any(|scheme| url.starts_with(scheme));
            let to = url.replacen("ws://", "http://", 1);
            assert!(
                local || to.starts_with(origin),
                "a request to {url}, off {origin}"
            );
            own += 1;
        }
        assert!(
            own > 5,
            "only {own} requests were seen: the log is not what it should be"
        );
    }

    /// Ends the browser.
    pub async fn close(self) {
        self.client.clone().close().await.expect("closed");
    }

    async fn log(&self, kind: &str) -> Vec<Value> {
        let log = self.own("se/log", json!({"type": kind})).await;
        log.as_array().cloned().expect("a list")
    }

    /// A command that only this driver knows.
    async fn own(&self, path: &'static str, body: Value) -> Value {
        let command = Own { path, body };
        self.client
            .issue_cmd(command)
            .await
            .unwrap_or_else(|error| panic!("{path}: {error}"))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The whole group: the driver, and a browser that it could not end because a test has failed.
        let group = format!("-{}", self.driver.id());
        drop(Command::new("kill").args(["-KILL", "--", &group]).status());
        drop(self.driver.wait());
    }
}

#[derive(Debug)]
struct Own {
    path: &'static str,
    body: Value,
}

impl WebDriverCompatibleCommand for Own {
    fn endpoint(&self, base: &url::Url, session: Option<&str>) -> Result<url::Url, url::ParseError> {
        base.join(&format!("session/{}/{}", session.unwrap_or_default(), self.path))
    }

    fn method_and_body(&self, _: &url::Url) -> (http::Method, Option<String>) {
        (http::Method::POST, Some(self.body.to_string()))
    }
}
