//! `car-node stress`.

use std::io::IsTerminal;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use car_node::control::parameter_sets::NamedSet;
use car_node::localization::Start;
use car_node::stress::{
    Defect, DefectKind, Drive, Measured, NotApplicable, Report, Row, SetReport, StressError, TruthFrom,
    Verdict, run as run_over,
};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use synpf::TrackMap;

use super::BadUsage;
use crate::cli::Stress;

pub(crate) fn run(arguments: &Stress) -> anyhow::Result<()> {
    let inputs = &arguments.inputs;
    let [bag] = &inputs.files[..] else {
        bail!(BadUsage("give one --bag: each needs a page of its own".into()));
    };
    let sets = arguments
        .params
        .iter()
        .map(|name| super::load_set(name))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let map = super::load_map(&inputs.map)?;
    let mut logs = super::read_bags(inputs)?;
    let Some((_, log)) = logs.pop() else {
        bail!(BadUsage("give --bag".into()));
    };
    let base_link_from_laser = super::mount(bag, &log).base_link_from_laser;
    let recorded = Drive {
        truth: log.truth.clone(),
        log,
        base_link_from_laser,
        longest_gap: 0.2,
    };
    let defects = chosen(arguments);
    let mut reports = Vec::new();
    for set in &sets {
        let report =
            stress(&recorded, &map, set, &defects, arguments).with_context(|| bag.display().to_string())?;
        reports.push(report);
    }
    let report = Report {
        bag: bag.clone(),
        map: inputs.map.clone(),
        seeds: arguments.seed.clone(),
        sets: reports,
    };
    if let Some(file) = &arguments.html {
        std::fs::write(file, report.to_html()).with_context(|| file.display().to_string())?;
    }
    if arguments.json {
        say!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        for set in &report.sets {
            print_set(bag, &report.seeds, set, Colours::of_stdout());
        }
    }
    Ok(())
}

/// The defects that the arguments name, in the order of the catalogue; without any, all of them.
fn chosen(arguments: &Stress) -> Vec<Defect> {
    let all = DefectKind::ALL.iter().flat_map(|kind| kind.grades());
    let named: Vec<Defect> = arguments
        .only
        .iter()
        .flat_map(|choice| choice.defects())
        .collect();
    all.filter(|defect| named.is_empty() || named.contains(defect))
        .collect()
}

/// Runs a set under all defects, in parallel on all cores.
fn stress(
    recorded: &Drive,
    map: &Arc<TrackMap>,
    set: &NamedSet,
    defects: &[Defect],
    arguments: &Stress,
) -> anyhow::Result<SetReport> {
    let first_seed = arguments.seed.first().copied().unwrap_or_default();
    let (drive, truth) = if recorded.truth.is_empty() {
        let start = arguments.initial_pose.unwrap_or(Start::Global);
        let drive = recorded.by_undamaged_run(map, &set.parameters, start, first_seed)?;
        (drive, TruthFrom::UndamagedRun)
    } else {
        (recorded.clone(), TruthFrom::Bag)
    };
    let duration_s = drive.log.span().map_or(0.0, |[first, last]| last.since(first));
    let seeds = &arguments.seed;
    let progress = progress_bar((defects.len() + 1) * seeds.len(), &set.name);
    let over = |damaged: &car_node::stress::DamagedDrive, seed: u64| {
        let measured = run_over(damaged, drive.base_link_from_laser, map, &set.parameters, seed);
        progress.inc(1);
        measured
    };
    let undamaged = seeds
        .par_iter()
        .map(|&seed| over(&drive.undamaged(), seed))
        .collect::<Result<Vec<_>, StressError>>()?;
    let rows = defects
        .par_iter()
        .map(|&defect| row(&drive, map, defect, seeds, &over))
        .collect::<Result<Vec<_>, StressError>>()?;
    progress.finish_and_clear();
    Ok(SetReport {
        set: set.name.clone(),
        truth,
        duration_s,
        undamaged,
        rows,
    })
}

/// A set under one defect, with each seed.
fn row(
    drive: &Drive,
    map: &TrackMap,
    defect: Defect,
    seeds: &[u64],
    over: &(impl Fn(&car_node::stress::DamagedDrive, u64) -> Result<Option<Measured>, StressError> + Sync),
) -> Result<Row, StressError> {
    let run = |&seed: &u64| -> Result<Result<Option<Measured>, NotApplicable>, StressError> {
        match drive.damaged(map.grid(), defect, seed) {
            Ok(damaged) => over(&damaged, seed).map(Ok),
            Err(reason) => Ok(Err(reason)),
        }
    };
    let runs = seeds.par_iter().map(run).collect::<Result<Vec<_>, _>>()?;
    // What does not apply to one seed does not apply to any.
    Ok(match runs.into_iter().collect::<Result<Vec<_>, _>>() {
        Ok(runs) => Row::of_runs(defect, runs),
        Err(reason) => Row::not_applicable(defect, reason.to_string()),
    })
}

fn progress_bar(runs: usize, set: &str) -> ProgressBar {
    let bar = ProgressBar::new(runs as u64);
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} runs, {eta} left") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    bar.set_message(format!("set {set}"));
    bar
}

/// Colours of a terminal; none where the output is a file, or where `NO_COLOR` is set.
#[derive(Debug, Clone, Copy)]
struct Colours(bool);

impl Colours {
    fn of_stdout() -> Self {
        Self(
            std::io::stdout().is_terminal()
                && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()),
        )
    }

    /// A verdict in its colour.
    fn verdict(self, verdict: Verdict) -> String {
        let code = match verdict {
            Verdict::Holds => "32",
            Verdict::Doubts => "36",
            Verdict::Warns => "33",
            Verdict::GivesUp | Verdict::NoPose => "35",
            Verdict::Misleads => "31",
        };
        if self.0 {
            format!("\x1b[{code}m{verdict}\x1b[0m")
        } else {
            verdict.to_string()
        }
    }
}

fn print_set(bag: &Path, seeds: &[u64], set: &SetReport, colours: Colours) {
    let seeds: Vec<_> = seeds.iter().map(ToString::to_string).collect();
    say!(
        "{}  set {}, seed {}, {:.0} s",
        bag.display(),
        set.set,
        seeds.join(" "),
        set.duration_s
    );
    say!("  {}", set.truth.text());
    match set.undamaged_error() {
        Some([rmse, max]) => say!(
            "  undamaged: position RMSE {} cm, at most {} cm",
            centimetres(rmse),
            centimetres(max)
        ),
        None => say!("  undamaged: no pose"),
    }
    say!(
        "  {:<18} {:<7} {:<13} {:>8} {:>8} {:>8} {:>9} {:>9} {:>8}  verdict",
        "defect",
        "grade",
        "size",
        "rmse cm",
        "max cm",
        "max deg",
        "LOCALIZED",
        "precision",
        "given up"
    );
    let mut part = None;
    for row in &set.rows {
        if part != Some(row.defect.part()) {
            part = Some(row.defect.part());
            say!(" {}", row.defect.part());
        }
        let name = format!("  {:<18} {:<7} {:<13}", row.defect, row.grade, row.size);
        let percent =
            |share: Option<f64>| share.map_or("-".to_owned(), |share| format!("{:.1} %", share * 100.0));
        let length = |metres: Option<f64>| metres.map_or("-".to_owned(), centimetres);
        match (&row.not_applicable, row.verdict) {
            (Some(reason), _) => say!("{name} does not apply: {reason}"),
            (None, Some(verdict)) => say!(
                "{name} {:>8} {:>8} {:>8} {:>9} {:>9} {:>8}  {}",
                length(row.rmse_m),
                length(row.max_m),
                row.heading_max_rad
                    .map_or("-".to_owned(), |angle| format!("{:.1}", angle.to_degrees())),
                percent(row.localized),
                percent(row.precision),
                row.given_up,
                colours.verdict(verdict)
            ),
            (None, None) => {}
        }
    }
    print_limits(set, colours);
}

fn centimetres(metres: f64) -> String {
    let value = metres * 100.0;
    if value < 100.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.0}")
    }
}

/// Prints where the set holds and where it does not.
fn print_limits(set: &SetReport, colours: Colours) {
    let limits = set.limits();
    let (holding, failing): (Vec<_>, Vec<_>) = limits
        .into_iter()
        .partition(|limit| limit.first_failure.is_none());
    let names: Vec<_> = holding.iter().map(|limit| limit.defect.name()).collect();
    if !names.is_empty() {
        say!(" holds in every grade that was tried: {}", names.join(", "));
    }
    for limit in failing {
        let Some((grade, verdict)) = limit.first_failure else {
            continue;
        };
        let to = limit
            .holds_to
            .map_or("does not hold".to_owned(), |grade| format!("holds when {grade}"));
        say!(
            "  {:<18} {to}; {grade}: {}",
            limit.defect,
            colours.verdict(verdict)
        );
    }
    let counts: Vec<String> = set
        .counts()
        .into_iter()
        .map(|(verdict, count)| format!("{} {count}", colours.verdict(verdict)))
        .collect();
    say!(" {}", counts.join(", "));
    for verdict in set.counts().into_keys() {
        say!("  {:<10} {}", verdict, verdict.meaning());
    }
}
