//! `car-node race --table`: the paper's table I, ours beside it.

use std::sync::Arc;

use car_node::race::{PAPER_ROWS, PaperRow, PoseSource, Quality, SPEED_SCALE};
use car_node::statistics::MeanSigma;
use simulator::Track;
use synpf::TrackMap;

use super::race::{Report, crashes, mean_sigma, name, or_dash, races, shipped};
use super::race_page;
use crate::cli;

/// Seeds of the table if the command line names no number.
const SEEDS: u64 = 5;

/// Races every localizer on both tyres, and prints the tables.
pub(super) fn run(arguments: &cli::Race, track: &Arc<Track>, map: &Arc<TrackMap>) -> anyhow::Result<()> {
    let arguments = &cli::Race {
        seeds: Some(arguments.seeds.unwrap_or(SEEDS)),
        ..arguments.clone()
    };
    let both = |source: (String, PoseSource)| [Quality::Hq, Quality::Lq].map(|tyres| (source.clone(), tyres));
    let mut rows = Vec::new();
    rows.extend(both(shipped("pose-graph")?));
    rows.extend(both(shipped("synpf-baseline")?));
    rows.extend([(shipped("hq")?, Quality::Hq), (shipped("lq")?, Quality::Lq)]);
    rows.extend(both(shipped("adaptive")?));
    rows.extend(both(shipped("pose-graph-tuned")?));
    rows.extend(both(("odometry".into(), PoseSource::Odometry)));
    rows.extend(both(("truth".into(), PoseSource::Truth)));
    let mut reports = Vec::new();
    for ((localizer, pose_source), quality) in rows {
        let mut report = races(arguments, track, map, localizer, pose_source, quality)?;
        report.races.clear();
        reports.push(report);
    }
    if let Some(file) = &arguments.html {
        race_page::write(file, arguments, &reports)?;
        eprintln!("car-node: the page is {}", file.display());
    }
    if arguments.json {
        say!("{}", serde_json::to_string_pretty(&reports)?);
        return Ok(());
    }
    print_absolute(arguments, &reports);
    say!("");
    print_lines(
        "relative to driving on the truth on the same tyres:",
        &relative(&reports),
    );
    say!("");
    print_lines("change from HQ to LQ:", &changes(&reports));
    say!("");
    say!(
        "what the paper's table says, and whether ours says it too (SynPF is synpf-baseline here, Cartographer pose-graph):"
    );
    for finding in findings(&reports) {
        let word = if finding.agrees { "yes" } else { "NO " };
        say!("  {word}  {}: {}", finding.what, finding.ours);
    }
    Ok(())
}

/// What was chosen so that the races resemble the paper's.
pub(super) fn chosen(reports: &[Report]) -> String {
    let track = reports.first().map_or("", |report| &report.track);
    format!(
        "chosen to resemble the paper: {SPEED_SCALE} of the raceline's speed on all tyres, which gives the paper's lap time on clean \
         ones; tyres that let go at 26 N and 19 N. The track {track} is not the paper's: compare differences, not values"
    )
}

/// A row of a table of differences; None where a value is missing.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Difference {
    pub(super) title: String,
    /// [s].
    pub(super) lap_time: Option<f64>,
    /// Distance of the estimate from the raceline [cm].
    pub(super) line_error: Option<f64>,
    /// Alignment by the paper's definition [percent].
    pub(super) alignment: Option<f64>,
}

/// Lap time [s], distance of the estimate from the raceline [cm], alignment [percent].
fn values(report: &Report) -> [Option<f64>; 3] {
    let summary = &report.summary;
    [
        summary.lap_time_s.map(|time| time.mean),
        summary.line_error_m.map(|error| 100.0 * error.mean),
        summary.alignment_paper.map(|share| 100.0 * share),
    ]
}

fn difference(title: String, from: [Option<f64>; 3], to: [Option<f64>; 3]) -> Difference {
    let [lap_time, line_error, alignment] = [0, 1, 2].map(|k| Some(to[k]? - from[k]?));
    Difference {
        title,
        lap_time,
        line_error,
        alignment,
    }
}

/// Each localizer less the truth, on the same tyres.
pub(super) fn relative(reports: &[Report]) -> Vec<Difference> {
    let truth = |quality| {
        reports
            .iter()
            .find(|other| other.localizer == "truth" && other.odometry == quality)
    };
    let driven = reports.iter().filter(|report| report.localizer != "truth");
    driven
        .filter_map(|report| {
            let title = format!("{} {}", report.localizer, name(report.odometry));
            Some(difference(title, values(truth(report.odometry)?), values(report)))
        })
        .collect()
}

/// LQ less HQ, ours and then the paper's.
pub(super) fn changes(reports: &[Report]) -> Vec<Difference> {
    let mut changes: Vec<Difference> = reports
        .chunks_exact(2)
        .map(|pair| {
            let [hq, lq] = [&pair[0].localizer, &pair[1].localizer];
            let title = if hq == lq {
                hq.clone()
            } else {
                format!("{hq}, {lq}")
            };
            difference(title, values(&pair[0]), values(&pair[1]))
        })
        .collect();
    changes.extend(PAPER_ROWS.chunks_exact(2).map(|pair| {
        let title = format!("the paper\u{2019}s {}", pair[0].localizer);
        difference(title, paper(&pair[0]), paper(&pair[1]))
    }));
    changes
}

fn paper(row: &PaperRow) -> [Option<f64>; 3] {
    [
        Some(row.lap_time_s[0]),
        Some(100.0 * row.line_error_m[0]),
        Some(100.0 * row.alignment),
    ]
}

/// One thing that the paper's table says.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Finding {
    pub(super) what: String,
    /// Our values.
    pub(super) ours: String,
    pub(super) agrees: bool,
}

/// The order of the methods on each tyre, and the sign of each change from HQ to LQ.
pub(super) fn findings(reports: &[Report]) -> Vec<Finding> {
    let ours = |localizer: &str, quality| {
        let found = reports
            .iter()
            .find(|report| report.localizer == localizer && report.odometry == quality);
        found.map_or([None; 3], values)
    };
    let theirs = |localizer: &str, quality| {
        let found = PAPER_ROWS
            .iter()
            .find(|row| row.localizer == localizer && row.quality == quality);
        found.map_or([None; 3], paper)
    };
    let pairs = [("synpf-baseline", "SynPF"), ("pose-graph", "Cartographer")];
    let quantities = [("lap time", "s"), ("error to the line", "cm"), ("alignment", "%")];
    let mut findings = Vec::new();
    let mut judge = |what: String, ours: [Option<f64>; 2], theirs: [Option<f64>; 2], unit: &str| {
        let [Some(a), Some(b)] = ours else { return };
        let [Some(p), Some(q)] = theirs else { return };
        findings.push(Finding {
            what,
            ours: format!("{a:.3} and {b:.3} {unit} (the paper: {p:.3} and {q:.3})"),
            agrees: (a < b) == (p < q),
        });
    };
    for quality in [Quality::Hq, Quality::Lq] {
        let [of, paper] = [0, 1].map(|which| {
            pairs.map(|pair| {
                if which == 0 {
                    ours(pair.0, quality)
                } else {
                    theirs(pair.1, quality)
                }
            })
        });
        for (k, (quantity, unit)) in quantities.into_iter().enumerate() {
            let order = if paper[0][k] < paper[1][k] { "less" } else { "more" };
            let what = format!("{quantity} on {}, SynPF {order} than Cartographer", name(quality));
            judge(what, [of[0][k], of[1][k]], [paper[0][k], paper[1][k]], unit);
        }
    }
    for (of, paper) in pairs {
        let [from, to] = [Quality::Hq, Quality::Lq].map(|quality| ours(of, quality));
        let [paper_from, paper_to] = [Quality::Hq, Quality::Lq].map(|quality| theirs(paper, quality));
        for (k, (quantity, unit)) in quantities.into_iter().enumerate() {
            let way = if paper_from[k] < paper_to[k] {
                "grows"
            } else {
                "falls"
            };
            let what = format!("{quantity} of {paper} {way} from HQ to LQ");
            judge(what, [from[k], to[k]], [paper_from[k], paper_to[k]], unit);
        }
    }
    findings
}

/// A value with its sign, or a dash.
pub(super) fn signed(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".into(), |value| format!("{value:+.digits$}"))
}

fn print_lines(title: &str, lines: &[Difference]) {
    say!("{title}");
    say!(
        "{:<32} {:>10} {:>15} {:>10}",
        "",
        "lap time",
        "error to line",
        "alignment"
    );
    say!("{:<32} {:>10} {:>15} {:>10}", "", "s", "cm", "points");
    for line in lines {
        say!(
            "{:<32} {:>10} {:>15} {:>10}",
            line.title,
            signed(line.lap_time, 3),
            signed(line.line_error, 2),
            signed(line.alignment, 2)
        );
    }
}

fn print_absolute(arguments: &cli::Race, reports: &[Report]) {
    say!(
        "laps on {}: {} with each of {} seeds; error to the line by the estimate, as the paper takes it, and by the truth",
        reports.first().map_or("", |report| &report.track),
        arguments.laps,
        reports.first().map_or(0, |report| report.seeds.len())
    );
    say!(
        "{:<17} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7} {:>8}",
        "localizer",
        "odom",
        "lap time",
        "error to line",
        "true",
        "align paper",
        "ours",
        "pos rmse",
        "hdg rmse",
        "load",
        "crashes"
    );
    say!(
        "{:<17} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7} {:>8}",
        "",
        "",
        "s",
        "cm",
        "cm",
        "%",
        "%",
        "cm",
        "deg",
        "% core",
        ""
    );
    for report in reports {
        let s = &report.summary;
        say!(
            "{:<17} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7.2} {:>8}",
            report.localizer,
            name(report.odometry),
            mean_sigma(s.lap_time_s, 1.0, 3),
            mean_sigma(s.line_error_m, 100.0, 2),
            or_dash(s.true_line_error_m.map(|error| error.mean), 100.0, 2),
            or_dash(s.alignment_paper, 100.0, 2),
            or_dash(s.alignment, 100.0, 2),
            or_dash(s.position_rmse_m, 100.0, 2),
            or_dash(s.heading_rmse_rad, 1_f64.to_degrees(), 2),
            s.load.cpu * 100.0,
            crashes(s),
        );
    }
    say!(
        "lap times are calibrated: {SPEED_SCALE} of the raceline's speed on all tyres gives the paper's on clean ones; compare with \
         the rows of the truth"
    );
    say!("the paper, table I (10 laps of a real car on its own track, both tyres at one speed scaling):");
    for row in PAPER_ROWS {
        let pair = |[mean, sigma]: [f64; 2]| Some(MeanSigma { mean, sigma });
        say!(
            "{:<17} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7} {:>8}",
            row.localizer,
            name(row.quality),
            mean_sigma(pair(row.lap_time_s), 1.0, 3),
            mean_sigma(pair(row.line_error_m), 100.0, 2),
            "-",
            or_dash(Some(row.alignment), 100.0, 2),
            "-",
            "-",
            "-",
            or_dash(row.load, 1.0, 2),
            "-"
        );
    }
}
