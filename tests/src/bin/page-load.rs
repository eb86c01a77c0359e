//! What twenty cars at full rate cost the pit wall, and how fast and how fresh its page is then.
//!
//! ```text
//! cargo build --release -p pitwall -p system-tests --features system-tests/browser
//! target/release/page-load --pitwall target/release/pitwall
//! ```
//!
//! Starts the program given, cars in a process of their own, and a headless Chromium that draws in software; then
//! measures for a while: pictures that the page drew, how old each was when drawn, CPU and memory of the program.
#![allow(clippy::print_stdout, reason = "this is the program's output")]

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Parser;
use serde_json::json;
use system_tests::{Browser, free_endpoint};

/// Measures the pit wall's page under load.
#[derive(Debug, Parser)]
struct Options {
    /// The program to measure.
    #[arg(long, value_name = "FILE")]
    pitwall: PathBuf,
    /// Cars, each with 40 poses a second and everything else at its rate.
    #[arg(long, default_value_t = 20)]
    cars: u32,
    /// How long to measure [s].
    #[arg(long = "for", default_value_t = 30)]
    seconds: u64,
    /// Record all the while.
    #[arg(long)]
    record: bool,
    /// Write JSON in place of a table.
    #[arg(long)]
    json: bool,
}

/// A process that ends with this program.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(measure(&options))
}

async fn measure(options: &Options) -> anyhow::Result<()> {
    let endpoint = free_endpoint();
    let page = free_endpoint().replace("tcp/", "");
    let recordings = tempfile::tempdir()?;
    let wall = Command::new(&options.pitwall)
        .args(["--listen", &endpoint, "--page", &page, "--recordings"])
        .arg(recordings.path())
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .with_context(|| options.pitwall.display().to_string())?;
    let wall = Running(wall);
    let me = std::env::current_exe()?;
    let cars = Command::new(me.with_file_name("test-car"))
        .args(["rings", &options.cars.to_string(), &endpoint])
        .stdin(Stdio::null())
        .spawn()
        .with_context(|| format!("test-car, beside {}", me.display()))?;
    let cars = Running(cars);
    wait_for(&page)?;
    let browser = Browser::open_without_logs(&format!("http://{page}/"), 1366, 768).await;
    let all = format!(
        "document.querySelectorAll('.card.good').length === {}",
        options.cars
    );
    browser.wait("every car is localized", &all).await;
    if options.record {
        browser.key("r").await;
        browser
            .wait("it records", "pitwall.snapshot.recording !== null")
            .await;
    }

    // Counts the snapshots drawn from here on. A callback requested during a frame runs in the next one, so
    // two snapshots within one frame count once.
    browser
        .evaluate("(() => { pitwall.ages.length = 0; window.drawn = 0; let seen = null; const count = () => { \
              if (pitwall.snapshot !== seen) { seen = pitwall.snapshot; window.drawn += 1; } requestAnimationFrame(count); }; \
              requestAnimationFrame(count); return 1; })()")
        .await;
    let (begun, busy) = (Instant::now(), cpu_seconds(wall.0.id())?);
    let mut ages: Vec<f64> = Vec::new();
    while begun.elapsed() < Duration::from_secs(options.seconds) {
        tokio::time::sleep(Duration::from_secs(5)).await;
        // The page keeps the last thousand ages. They are fetched before they are overwritten.
        let taken = browser.evaluate("pitwall.ages.splice(0)").await;
        ages.extend(
            taken
                .as_array()
                .into_iter()
                .flatten()
                .filter_map(serde_json::Value::as_f64),
        );
    }
    let seconds = begun.elapsed().as_secs_f64();
    let cores = (cpu_seconds(wall.0.id())? - busy) / seconds;
    let drawn = browser
        .evaluate("window.drawn")
        .await
        .as_f64()
        .context("a count")?;
    let poses = browser
        .evaluate("pitwall.snapshot.cars.reduce((sum, car) => sum + car.streams.pose.rate_hz, 0)")
        .await;
    let missing = browser
        .evaluate("pitwall.snapshot.cars.reduce((sum, car) => sum + Object.values(car.streams).reduce((n, s) => n + s.missing, 0), 0)")
        .await;
    let memory = status(wall.0.id(), "VmRSS:")? / 1e3;
    let peak = status(wall.0.id(), "VmHWM:")? / 1e3;
    browser.screenshot("page-load").await;
    browser.close().await;
    drop((cars, wall));

    ensure!(!ages.is_empty(), "the page has drawn nothing");
    ages.sort_by(f64::total_cmp);
    let quantile = |q: f64| ages[((ages.len() - 1) as f64 * q) as usize];
    let rate = drawn / seconds;
    if options.json {
        println!(
            "{}",
            json!({
                "cars": options.cars, "seconds": seconds, "poses_per_s": poses, "missing": missing,
                "pictures_per_s": rate, "age_ms_p50": quantile(0.5), "age_ms_p99": quantile(0.99), "age_ms_max": quantile(1.0),
                "pitwall_cores": cores, "pitwall_memory_mb": memory, "pitwall_peak_mb": peak,
            })
        );
    } else {
        println!(
            "{} cars, {seconds:.0} s, {poses:.0} poses/s in all, {missing} messages missing",
            options.cars
        );
        println!("page       {rate:>7.1} pictures/s                     wanted: 10 or more");
        println!(
            "snapshot   {:>7.0} ms p50, {:.0} ms p99, {:.0} ms max     wanted: p99 under 150 ms",
            quantile(0.5),
            quantile(0.99),
            quantile(1.0)
        );
        println!("pitwall    {cores:>7.2} cores                          wanted: under 0.5");
        println!("           {memory:>7.0} MB, {peak:.0} MB at most              wanted: under 200 MB");
    }
    Ok(())
}

/// Waits until somebody listens at `address`.
fn wait_for(address: &str) -> anyhow::Result<()> {
    let deadline = Instant::now() + Duration::from_secs(20);
    while std::net::TcpStream::connect(address).is_err() {
        ensure!(Instant::now() < deadline, "nobody listens at {address}");
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// CPU time that a process has used \[s\].
fn cpu_seconds(pid: u32) -> anyhow::Result<f64> {
    /// Linux counts in hundredths of a second, whatever the kernel's own tick.
    const TICKS: f64 = 100.0;
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).context("the pit wall has ended")?;
    // The name, in parentheses, may hold spaces.
    let fields: Vec<&str> = stat
        .rsplit(')')
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .collect();
    let ticks = |i: usize| {
        fields
            .get(i)
            .and_then(|f| f.parse::<f64>().ok())
            .context("/proc/PID/stat")
    };
    Ok((ticks(11)? + ticks(12)?) / TICKS)
}

/// A number of /proc/PID/status \[kB\].
fn status(pid: u32, name: &str) -> anyhow::Result<f64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/status")).context("the pit wall has ended")?;
    text.lines()
        .find_map(|line| line.strip_prefix(name)?.split_whitespace().next()?.parse().ok())
        .with_context(|| format!("{name} in /proc/{pid}/status"))
}
