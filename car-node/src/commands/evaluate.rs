//! `car-node evaluate`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use car_node::control::parameter_sets::NamedSet;
use car_node::evaluate::{Fault, FaultReport, Nees, Outcome, Truth, run as run_over};
use car_node::health::State;
use car_node::localization::{EXTERNAL, Start};
use car_node::sensors::bag::SensorLog;
use car_node::statistics::ErrorSummary;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use synpf::{Localizer, Update};

use super::BadUsage;
use crate::cli::Evaluate;

/// The range table of the map, as reported.
#[derive(Debug, Clone, Copy, Serialize)]
struct RangeTable {
    /// Time to build it \[ms\].
    build_ms: f64,
    /// Memory that it takes.
    bytes: usize,
}

/// One bag under one seed, as reported.
#[derive(Debug, Serialize)]
struct Report {
    bag: PathBuf,
    params: String,
    seed: u64,
    #[serde(flatten)]
    outcome: Outcome,
    /// How the health state reacted to each `--fault`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    faults: Vec<FaultReport>,
    range_table: RangeTable,
}

pub(crate) fn run(arguments: &Evaluate) -> anyhow::Result<()> {
    let runs = arguments.bags.files.len() * arguments.seed.len();
    if arguments.poses.is_some() && (runs > 1 || arguments.beside.is_some()) {
        let text = "--poses writes the poses of one run: give one --bag, one --seed and no --beside";
        bail!(BadUsage(text.into()));
    }
    let mut faults = arguments.fault.clone();
    faults.sort_by(|a, b| a.at.total_cmp(&b.at));
    let set = match super::chosen_set(arguments.params.as_deref(), arguments.localizer)? {
        Some(set) => set,
        None => super::load_set("hq")?,
    };
    let beside = super::set_beside(arguments.beside.as_deref(), Some(&set))?;
    let sets: Vec<NamedSet> = std::iter::once(set).chain(beside).collect();
    super::check_pose_topic(&sets, arguments.bags.topics.external_pose_topic.as_deref())?;
    let map = super::load_map(&arguments.bags.map)?;
    let mut logs = super::read_bags(&arguments.bags)?;
    for (bag, log) in &mut logs {
        let lasts = log.span().map_or(0.0, |[first, last]| last.since(first));
        if let Some(late) = faults.iter().find(|fault| fault.shows_at() > lasts) {
            let text = format!(
                "--fault {late}: {} ends {lasts:.1} s after its first scan",
                bag.display()
            );
            bail!(BadUsage(text));
        }
        // The last fault first: cutting a piece out moves everything after it.
        for fault in faults.iter().rev() {
            fault.apply(log);
        }
    }
    // The table covers only what the car can reach from its start, if that is known: a whole building takes a minute and a
    // gigabyte.
    let start = arguments.initial_pose.unwrap_or(Start::Global);
    let place = match start {
        Start::Pose(pose) => Some(pose),
        Start::Truth => logs
            .first()
            .and_then(|(_, log)| log.truth.first())
            .map(|(_, pose)| *pose),
        Start::Global => None,
    };
    let before = Instant::now();
    for set in &sets {
        set.parameters.prepare_tables(&map, place);
    }
    let range_table = RangeTable {
        build_ms: before.elapsed().as_secs_f64() * 1e3,
        bytes: map.table_bytes(),
    };

    let mut poses = arguments.poses.as_deref().map(PoseFile::create).transpose()?;
    let mut reports = Vec::new();
    for (bag, log) in &logs {
        let truth = Truth::new(log.truth.clone());
        let mount = super::mount(bag, log);
        let runs = sets
            .iter()
            .flat_map(|set| arguments.seed.iter().map(move |&seed| (set, seed)));
        for (set, seed) in runs {
            let mut localizer = set.parameters.build(&map, mount.base_link_from_laser, seed)?;
            let progress = progress_bar(bag, seed);
            // Another localizer has its own start.
            let start = if set.parameters.kind() == EXTERNAL {
                Start::Global
            } else {
                start
            };
            let outcome = over_bag(localizer.as_mut(), log, &truth, start, poses.as_mut(), &progress)
                .with_context(|| bag.display().to_string())?;
            reports.push(Report {
                bag: bag.into(),
                params: set.name.clone(),
                seed,
                faults: fault_reports(&faults, &outcome),
                outcome,
                range_table,
            });
        }
    }

    match &reports[..] {
        [report] if arguments.json => say!("{}", serde_json::to_string_pretty(report)?),
        reports if arguments.json => say!("{}", serde_json::to_string_pretty(reports)?),
        [report] => print_one(report),
        reports => print_table(reports),
    }
    Ok(())
}

/// How the state reacted to each fault. A kidnapping or a splice cuts its time out of the log: everything after it moves by
/// that time.
fn fault_reports(faults: &[Fault], outcome: &Outcome) -> Vec<FaultReport> {
    let mut cut = 0.0;
    let moved: Vec<Fault> = faults
        .iter()
        .map(|fault| {
            let at = fault.at - cut;
            if fault.kind.cuts() {
                cut += fault.duration;
            }
            Fault { at, ..*fault }
        })
        .collect();
    moved
        .iter()
        .enumerate()
        .map(|(index, fault)| {
            let until = moved.get(index + 1).map_or(f64::INFINITY, |next| next.at);
            FaultReport {
                fault: faults[index].to_string(),
                ..FaultReport::new(fault, until, &outcome.state_changes)
            }
        })
        .collect()
}

fn over_bag(
    localizer: &mut dyn Localizer,
    log: &SensorLog,
    truth: &Truth,
    start: Start,
    mut poses: Option<&mut PoseFile>,
    progress: &ProgressBar,
) -> anyhow::Result<Outcome> {
    let mut failed = None;
    let outcome = run_over(localizer, &log.arrivals, truth, start, |update, state, done| {
        if update.number.is_multiple_of(64) {
            progress.set_position((done * 1000.0) as u64);
        }
        if let Some(poses) = &mut poses
            && let Err(error) = poses.write(update, state)
        {
            failed.get_or_insert(error);
        }
    });
    progress.finish_and_clear();
    if let Some(poses) = poses {
        failed
            .map_or_else(|| poses.file.flush(), Err)
            .with_context(|| poses.path.display().to_string())?;
    }
    Ok(outcome?)
}

fn progress_bar(bag: &Path, seed: u64) -> ProgressBar {
    // Drawn on stderr, and only when that is a terminal.
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {percent}%") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    bar.set_message(format!("{} seed {seed}", bag.display()));
    bar
}

/// The columns of `--poses`: the pose, its covariance in m^2, m rad and rad^2, the health state, the localizer's mode, and
/// the scan's alignment and shares of short and long beams.
const COLUMNS: &str = "stamp_s,x_m,y_m,heading_rad,xx,xy,yy,xh,yh,hh,state,mode,align,short,long";

/// The CSV file of `--poses`.
struct PoseFile {
    path: PathBuf,
    file: BufWriter<File>,
}

impl PoseFile {
    fn create(path: &Path) -> anyhow::Result<Self> {
        let file = File::create(path).with_context(|| path.display().to_string())?;
        let mut file = BufWriter::new(file);
        writeln!(file, "{COLUMNS}").with_context(|| path.display().to_string())?;
        Ok(Self {
            path: path.into(),
            file,
        })
    }

    fn write(&mut self, update: &Update, state: State) -> std::io::Result<()> {
        let (seconds, nanoseconds) = (
            update.stamp.0.div_euclid(1_000_000_000),
            update.stamp.0.rem_euclid(1_000_000_000),
        );
        let pose = update.pose;
        write!(
            self.file,
            "{seconds}.{nanoseconds:09},{:.6},{:.6},{:.6}",
            pose.x, pose.y, pose.heading
        )?;
        for (row, column) in [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)] {
            write!(self.file, ",{:.6e}", update.covariance[(row, column)])?;
        }
        writeln!(
            self.file,
            ",{state:?},{:?},{:.4},{:.4},{:.4}",
            update.mode, update.alignment, update.short_beams, update.long_beams
        )
    }
}

/// Prints one run in full.
fn print_one(report: &Report) {
    let Report {
        outcome, range_table, ..
    } = report;
    say!(
        "{}  set {}, seed {}",
        report.bag.display(),
        report.params,
        report.seed
    );
    say!("  scans        {:>9}", outcome.scans);
    say!("  updates      {:>9}", outcome.updates);
    for (cause, count) in &outcome.dropped {
        say!("  dropped      {count:>9}  {cause}");
    }
    match &outcome.errors {
        Some(errors) => {
            say!("  error             mean      rmse       p95       max");
            let line = |name: &str, unit: &str, scale: f64, of: &ErrorSummary| {
                say!(
                    "  {name:<12} {:>9.2} {:>9.2} {:>9.2} {:>9.2}  {unit}",
                    of.mean * scale,
                    of.rmse * scale,
                    of.p95 * scale,
                    of.max * scale
                );
            };
            line("position", "cm", 100.0, &errors.position_error_m);
            line("lateral", "cm", 100.0, &errors.lateral_error_m);
            line("longitudinal", "cm", 100.0, &errors.longitudinal_error_m);
            line("heading", "deg", 1_f64.to_degrees(), &errors.heading_error_rad);
            say!("  excursions   {:>9}", errors.excursions);
            if let Some(nees) = &outcome.nees {
                let line = |name: &str, dimension: u32, of: &Nees| {
                    say!(
                        "  {name:<12} {:>9.2}  NEES (consistent: {dimension}); {:.1}% above the 95% bound",
                        of.mean,
                        of.above_95 * 100.0
                    );
                };
                line("position", 2, &nees.position);
                line("heading", 1, &nees.heading);
            }
        }
        None => say!("  error        no truth to compare with"),
    }
    if let Some(alignment) = outcome.alignment {
        say!(
            "  alignment    {:>9.3}  mean, {:.3} p05",
            alignment.mean,
            alignment.p05
        );
    }
    for (state, share) in &outcome.state_share {
        say!("  {:<12} {:>8.1}%", state, share * 100.0);
    }
    if let Some(truth) = outcome.state_truth {
        let percent =
            |share: Option<f64>| share.map_or("-".to_owned(), |share| format!("{:.1}%", share * 100.0));
        say!(
            "  LOCALIZED    precision {}, recall {}; {} updates LOST though right, {} LOCALIZED though wrong",
            percent(truth.precision),
            percent(truth.recall),
            truth.false_lost,
            truth.false_localized
        );
    }
    for fault in &report.faults {
        let after = |seconds: Option<f64>| seconds.map_or("never".to_owned(), |s| format!("after {s:.2} s"));
        say!(
            "  {:<16} LOST {}, STALE {}, LOCALIZED again {}",
            fault.fault,
            after(fault.lost_after_s),
            after(fault.stale_after_s),
            after(fault.localized_after_s)
        );
    }
    if let Some(times) = outcome.update_us {
        say!(
            "  update       {:>9.0}  us p50, {:.0} p99, {:.0} max",
            times.p50,
            times.p99,
            times.max
        );
    }
    if let Some(particles) = outcome.particles {
        say!("  particles    {:>9.0}", particles.mean);
    }
    say!(
        "  range table  {:>9.0}  ms, {:.1} MB",
        range_table.build_ms,
        range_table.bytes as f64 / 1e6
    );
}

/// Prints several runs, one row each.
fn print_table(reports: &[Report]) {
    say!(
        "{:<28} {:<14} {:>4} {:>7} {:>7} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>6} {:>6} {:>6} {:>7} {:>7}",
        "bag",
        "set",
        "seed",
        "updates",
        "dropped",
        "pos rmse",
        "lat rmse",
        "lon rmse",
        "hdg rmse",
        "pos nees",
        "hdg nees",
        "excurs",
        "align",
        "al p05",
        "us p50",
        "us p99"
    );
    say!(
        "{:<28} {:<14} {:>4} {:>7} {:>7} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "",
        "",
        "",
        "",
        "",
        "cm",
        "cm",
        "cm",
        "deg",
        "of 2",
        "of 1"
    );
    let mut previous = None;
    for report in reports {
        let outcome = &report.outcome;
        let or_dash =
            |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
        let rmse = |of: fn(&car_node::evaluate::Summaries) -> ErrorSummary, scale: f64| {
            or_dash(outcome.errors.as_ref().map(|errors| of(errors).rmse * scale), 2)
        };
        let name = if previous == Some(&report.bag) {
            String::new()
        } else {
            short_name(&report.bag)
        };
        previous = Some(&report.bag);
        say!(
            "{name:<28} {:<14} {:>4} {:>7} {:>7} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>6} {:>6} {:>6} {:>7} {:>7}",
            report.params,
            report.seed,
            outcome.updates,
            outcome.dropped.values().sum::<usize>(),
            rmse(|errors| errors.position_error_m, 100.0),
            rmse(|errors| errors.lateral_error_m, 100.0),
            rmse(|errors| errors.longitudinal_error_m, 100.0),
            rmse(|errors| errors.heading_error_rad, 1_f64.to_degrees()),
            or_dash(outcome.nees.as_ref().map(|nees| nees.position.mean), 2),
            or_dash(outcome.nees.as_ref().map(|nees| nees.heading.mean), 2),
            or_dash(outcome.errors.as_ref().map(|errors| errors.excursions as f64), 0),
            or_dash(outcome.alignment.map(|alignment| alignment.mean), 3),
            or_dash(outcome.alignment.map(|alignment| alignment.p05), 3),
            or_dash(outcome.update_us.map(|times| times.p50), 0),
            or_dash(outcome.update_us.map(|times| times.p99), 0),
        );
    }
}

/// The file with the folder that it is in: `jfr5/hq.mcap`.
fn short_name(path: &Path) -> String {
    let components: Vec<_> = path.iter().map(|part| part.to_string_lossy()).collect();
    components[components.len().saturating_sub(2)..].join("/")
}
