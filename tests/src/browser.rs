//! A headless Chromium, controlled through `WebDriver`.

use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fantoccini::actions::{InputSource, MOUSE_BUTTON_LEFT, MouseActions, PointerAction};
use fantoccini::wd::WebDriverCompatibleCommand;
use fantoccini::{Client, ClientBuilder, Locator};
use hyper_util::client::legacy::connect::HttpConnector;
use serde_json::{Value, json};

/// How long the browser may take to start, and a condition on the page to hold. It is long, because machines may be busy.
const DEADLINE: Duration = Duration::from_secs(90);

/// A browser with one page. Dropping it ends the process.
pub struct Browser {
    client: Client,
    driver: Child,
    _profile: tempfile::TempDir,
}

impl Browser {
    /// Opens `url` in a new browser whose viewport has `width` times `height` pixels. The console and all requests are
    /// logged.
    pub async fn open(url: &str, width: u32, height: u32) -> Self {
        Self::start(
            url,
            width,
            height,
            json!({"browser": "ALL", "performance": "ALL"}),
        )
        .await
    }

    /// As [`Self::open`], without logs. The network log contains every snapshot, which would disturb measurements.
    pub async fn open_without_logs(url: &str, width: u32, height: u32) -> Self {
        Self::start(url, width, height, json!({})).await
    }

    async fn start(url: &str, width: u32, height: u32, logs: Value) -> Self {
        let port = crate::free_endpoint()
            .rsplit_once(':')
            .map(|(_, port)| port.to_owned())
            .expect("a port");
        // The driver gets its own process group, so that everything it starts can be ended.
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
        let deadline = Instant::now() + DEADLINE;
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

    /// Sets the viewport to `width` times `height` pixels.
    pub async fn resize(&self, width: u32, height: u32) {
        let metrics = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": false});
        self.driver_command(
            "goog/cdp/execute",
            json!({"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics}),
        )
        .await;
    }

    /// Evaluates a JavaScript expression on the page.
    pub async fn evaluate(&self, script: &str) -> Value {
        self.client
            .execute(&format!("return {script}"), Vec::new())
            .await
            .unwrap_or_else(|error| panic!("{script}: {error}"))
    }

    /// Waits until an expression is truthy, and returns its value. `what` describes the condition.
    pub async fn wait(&self, what: &str, script: &str) -> Value {
        let deadline = Instant::now() + DEADLINE;
        loop {
            let value = self.evaluate(&format!("({script}) || null")).await;
            if !value.is_null() {
                return value;
            }
            if Instant::now() >= deadline {
                let cards = self
                    .evaluate("[...document.querySelectorAll('.card')].map((c) => c.innerText)")
                    .await;
                panic!("not within {DEADLINE:?}: {what}\n{script}\ncards: {cards:#}");
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Clicks the first element that matches `css`.
    pub async fn click(&self, css: &str) {
        let element = self.client.find(Locator::Css(css)).await;
        let element = element.unwrap_or_else(|error| panic!("{css}: {error}"));
        element
            .click()
            .await
            .unwrap_or_else(|error| panic!("click on {css}: {error}"));
    }

    /// Replaces the text of the input that matches `css`, and presses Enter.
    pub async fn fill(&self, css: &str, text: &str) {
        let element = self.client.find(Locator::Css(css)).await;
        let element = element.unwrap_or_else(|error| panic!("{css}: {error}"));
        // Clearing through the driver would fire a change event.
        let empty = format!("(document.querySelector('{css}').value = '')");
        self.evaluate(&empty).await;
        element.send_keys(&format!("{text}\n")).await.expect("typed");
    }

    /// Sends a key press to the page.
    pub async fn key(&self, key: &str) {
        let event = format!("new KeyboardEvent('keydown', {{key: '{key}', bubbles: true}})");
        self.evaluate(&format!("document.body.dispatchEvent({event})"))
            .await;
    }

    /// Drags the mouse from one point of the page to another \[px\].
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

    /// Saves a screenshot as `NAME.png` in the folder that `PITWALL_CI_OUTPUT` names, else in the folder for temporary files.
    pub async fn screenshot(&self, name: &str) -> PathBuf {
        let folder = std::env::var_os("PITWALL_CI_OUTPUT").map_or_else(std::env::temp_dir, PathBuf::from);
        std::fs::create_dir_all(&folder).expect("a folder for screenshots");
        let png = self.client.screenshot().await.expect("a screenshot");
        let file = folder.join(format!("{name}.png"));
        std::fs::write(&file, png).expect("written");
        file
    }

    /// Fails if the console has an error or a warning, or if the page sent a request to another origin.
    pub async fn expect_clean(&self, origin: &str) {
        let console = self.log("browser").await;
        let bad = |entry: &&Value| entry["level"] == "SEVERE" || entry["level"] == "WARNING";
        let bad: Vec<_> = console.iter().filter(bad).collect();
        assert!(bad.is_empty(), "errors in the console: {bad:#?}");
        let mut requests = 0;
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
            // Requests of the browser's empty tab are not the page's.
            if params["documentURL"]
                .as_str()
                .is_some_and(|page| page.starts_with("chrome"))
            {
                continue;
            }
            let local = ["data:", "blob:", "about:"]
                .iter()
                .any(|scheme| url.starts_with(scheme));
            let target = url.replacen("ws://", "http://", 1);
            assert!(
                local || target.starts_with(origin),
                "a request to {url}, which is not at {origin}"
            );
            requests += 1;
        }
        assert!(
            requests > 5,
            "only {requests} requests in the log, which must be incomplete"
        );
    }

    /// Ends the browser.
    pub async fn close(self) {
        self.client.clone().close().await.expect("closed");
    }

    async fn log(&self, kind: &str) -> Vec<Value> {
        let log = self.driver_command("se/log", json!({"type": kind})).await;
        log.as_array().cloned().expect("a list")
    }

    /// Sends a command that is specific to chromedriver.
    async fn driver_command(&self, path: &'static str, body: Value) -> Value {
        let command = DriverCommand { path, body };
        self.client
            .issue_cmd(command)
            .await
            .unwrap_or_else(|error| panic!("{path}: {error}"))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Ends the whole group, because a failed test leaves the browser open.
        let group = format!("-{}", self.driver.id());
        drop(Command::new("kill").args(["-KILL", "--", &group]).status());
        drop(self.driver.wait());
    }
}

#[derive(Debug)]
struct DriverCommand {
    path: &'static str,
    body: Value,
}

impl WebDriverCompatibleCommand for DriverCommand {
    fn endpoint(&self, base: &url::Url, session: Option<&str>) -> Result<url::Url, url::ParseError> {
        base.join(&format!("session/{}/{}", session.unwrap_or_default(), self.path))
    }

    fn method_and_body(&self, _: &url::Url) -> (http::Method, Option<String>) {
        (http::Method::POST, Some(self.body.to_string()))
    }
}
