//! The page of `car-node race --table --html`: the tables, the deviation along the track and the distributions of the laps.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context;
use car_node::race::{LapRecord, PAPER_ROWS, Quality};
use car_node::statistics::MeanSigma;

use super::race::{Report, crashes, mean_sigma, name, or_dash};
use super::race_table::{Difference, changes, chosen, findings, relative, signed};
use crate::cli;

/// Colours of the localizers, in the order of the rows; legible to the colour-blind (Okabe and Ito).
const COLOURS: [&str; 8] = [
    "#0072b2", "#d55e00", "#009e73", "#000000", "#cc79a7", "#56b4e9", "#e69f00", "#666666",
];

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:76em;margin:2em auto;padding:0 1em;color:#222}\
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}table{border-collapse:collapse}\
th,td{padding:.2em .8em;text-align:right;border-bottom:1px solid #ddd}td{white-space:nowrap}th:first-child,td:first-child{text-align:left}\
tr.paper td{color:#666;font-style:italic}.no{color:#b00020;font-weight:600}.legend span{margin-right:1.4em;white-space:nowrap}\
svg{max-width:100%;height:auto}";

/// Writes the page.
pub(super) fn write(file: &Path, arguments: &cli::Race, reports: &[Report]) -> anyhow::Result<()> {
    std::fs::write(file, page(arguments, reports)).with_context(|| file.display().to_string())
}

/// A title that came from the command line, for HTML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

fn page(arguments: &cli::Race, reports: &[Report]) -> String {
    let track = escaped(reports.first().map_or("", |report| &report.track));
    let seeds = reports.first().map_or(0, |report| report.seeds.len());
    let legend = reports
        .iter()
        .enumerate()
        .filter(|(i, report)| {
            reports[..*i]
                .iter()
                .all(|other| other.localizer != report.localizer)
        })
        .map(|(i, report)| {
            format!(
                "<span style=\"color:{}\">&#9632; {}</span>",
                colour(i),
                escaped(&report.localizer)
            )
        })
        .collect::<Vec<_>>()
        .concat();
    let charts: String = [Quality::Hq, Quality::Lq]
        .map(|quality| {
            format!(
                "<h2>{} tyres</h2><p class=legend>{legend}</p><h3>Distance of the car from the raceline, along the track</h3>{}\
                 <h3>Laps: lap time, and distance of the car from the raceline</h3>{}",
                name(quality),
                along_track(reports, quality),
                distributions(reports, quality)
            )
        })
        .concat();
    format!(
        "<!doctype html><html lang=en><meta charset=utf-8><title>Table I on {track}</title><style>{STYLE}</style>\
         <h1>Table I on {track}: {} laps, {seeds} seeds</h1><p>{}.</p><h2>Absolute</h2>{}\
         <h2>Relative to driving on the truth, on the same tyres</h2>{}<h2>Change from HQ to LQ</h2>{}\
         <h2>What the paper\u{2019}s table says, and whether ours says it too</h2>\
         <p>SynPF is synpf-baseline here, and Cartographer is pose-graph.</p>{}{charts}</html>\n",
        arguments.laps,
        escaped(&chosen(reports)),
        absolute(reports),
        differences(&relative(reports)),
        differences(&changes(reports)),
        findings_table(reports),
    )
}

fn colour(report: usize) -> &'static str {
    COLOURS[(report / 2).min(COLOURS.len() - 1)]
}

fn row(cells: &[String], class: &str) -> String {
    let cells: Vec<String> = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
    let cells = cells.concat();
    format!("<tr{class}>{cells}</tr>")
}

fn head(cells: &[&str]) -> String {
    let cells: Vec<String> = cells.iter().map(|cell| format!("<th>{cell}</th>")).collect();
    let cells = cells.concat();
    format!("<tr>{cells}</tr>")
}

fn absolute(reports: &[Report]) -> String {
    let mut table = head(&[
        "localizer",
        "tyres",
        "lap time, s",
        "estimate to line, cm",
        "car to line, cm",
        "alignment, %",
        "position, cm rmse",
        "load, % of a core",
        "crashes",
    ]);
    for report in reports {
        let s = &report.summary;
        table += &row(
            &[
                escaped(&report.localizer),
                name(report.odometry).into(),
                mean_sigma(s.lap_time_s, 1.0, 3),
                mean_sigma(s.line_error_m, 100.0, 2),
                or_dash(s.true_line_error_m.map(|error| error.mean), 100.0, 2),
                or_dash(s.alignment_paper, 100.0, 2),
                or_dash(s.position_rmse_m, 100.0, 2),
                format!("{:.2}", 100.0 * s.load.cpu),
                crashes(s),
            ],
            "",
        );
    }
    for paper in PAPER_ROWS {
        let pair = |[mean, sigma]: [f64; 2]| Some(MeanSigma { mean, sigma });
        table += &row(
            &[
                format!("the paper\u{2019}s {}", paper.localizer),
                name(paper.quality).into(),
                mean_sigma(pair(paper.lap_time_s), 1.0, 3),
                mean_sigma(pair(paper.line_error_m), 100.0, 2),
                "-".into(),
                or_dash(Some(paper.alignment), 100.0, 2),
                "-".into(),
                or_dash(paper.load, 1.0, 2),
                "-".into(),
            ],
            " class=paper",
        );
    }
    format!("<table>{table}</table>")
}

fn differences(lines: &[Difference]) -> String {
    let mut table = head(&["", "lap time, s", "estimate to line, cm", "alignment, points"]);
    for line in lines {
        let class = if line.title.starts_with("the paper") {
            " class=paper"
        } else {
            ""
        };
        table += &row(
            &[
                escaped(&line.title),
                signed(line.lap_time, 3),
                signed(line.line_error, 2),
                signed(line.alignment, 2),
            ],
            class,
        );
    }
    format!("<table>{table}</table>")
}

fn findings_table(reports: &[Report]) -> String {
    let mut table = head(&["the paper", "ours", "agrees"]);
    for finding in findings(reports) {
        let agrees = if finding.agrees {
            "yes"
        } else {
            "<span class=no>no</span>"
        };
        table += &row(&[finding.what, finding.ours, agrees.into()], "");
    }
    format!("<table>{table}</table>")
}

/// A drawing area with axes.
struct Chart {
    body: String,
    x: [f64; 2],
    y: [f64; 2],
    size: [f64; 2],
}

/// Room for the labels of the axes.
const LEFT: f64 = 130.0;
const BELOW: f64 = 40.0;

impl Chart {
    /// A chart whose rows have names at heights, in place of values, if there are any.
    fn new(
        size: [f64; 2],
        x: [f64; 2],
        y: [f64; 2],
        titles: [&str; 2],
        row_names: &[(String, f64, &str)],
    ) -> Self {
        let mut chart = Self {
            body: String::new(),
            x,
            y,
            size,
        };
        let (x0, x1, below) = (chart.at_x(x[0]), chart.at_x(x[1]), chart.at_y(y[0]));
        for value in ticks(y) {
            let at = chart.at_y(value);
            chart.add(format_args!(
                "<line x1=\"{x0:.1}\" x2=\"{x1:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#e5e5e5\"/>"
            ));
            if row_names.is_empty() {
                chart.label_y(at, &label(value, y[1] - y[0]), "#222");
            }
        }
        for (name, at, colour) in row_names {
            let at = chart.at_y(*at);
            chart.label_y(at, name, colour);
        }
        for value in ticks(x) {
            let (at, text, low) = (chart.at_x(value), label(value, x[1] - x[0]), below + 16.0);
            chart.add(format_args!(
                "<text x=\"{at:.1}\" y=\"{low:.1}\" text-anchor=\"middle\">{text}</text>"
            ));
        }
        let (middle, below) = (0.5 * (chart.at_x(x[0]) + chart.at_x(x[1])), size[1] - 6.0);
        let [title_x, title_y] = titles;
        chart.add(format_args!(
            "<text x=\"{middle:.1}\" y=\"{below:.1}\" text-anchor=\"middle\">{title_x}</text><text x=\"4\" y=\"12\">{title_y}</text>"
        ));
        chart
    }

    /// A label left of the axis.
    fn label_y(&mut self, at: f64, text: &str, colour: &str) {
        let (x, y) = (LEFT - 6.0, at + 4.0);
        self.add(format_args!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"end\" fill=\"{colour}\">{text}</text>"
        ));
    }

    fn at_x(&self, x: f64) -> f64 {
        LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * (self.size[0] - LEFT - 20.0)
    }

    fn at_y(&self, y: f64) -> f64 {
        let share = (y - self.y[0]) / (self.y[1] - self.y[0]);
        self.size[1] - BELOW - share * (self.size[1] - BELOW - 22.0)
    }

    fn add(&mut self, part: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        self.body.write_fmt(part).ok();
    }

    fn line(&mut self, points: impl Iterator<Item = [f64; 2]>, colour: &str) {
        let path: Vec<String> = points
            .map(|[x, y]| format!("{:.1},{:.1}", self.at_x(x), self.at_y(y)))
            .collect();
        let path = path.join(" ");
        self.add(format_args!(
            "<polyline points=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\"/>"
        ));
    }

    fn dot(&mut self, [x, y]: [f64; 2], colour: &str) {
        let (x, y) = (self.at_x(x), self.at_y(y));
        self.add(format_args!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\" fill=\"{colour}\" fill-opacity=\"0.45\"/>"
        ));
    }

    fn svg(self) -> String {
        let [width, height] = self.size;
        format!(
            "<svg viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" font-size=\"12\" \
             font-family=\"system-ui,sans-serif\" xmlns=\"http://www.w3.org/2000/svg\">{}</svg>",
            self.body
        )
    }
}

/// Round values on an axis, about five.
fn ticks([low, high]: [f64; 2]) -> Vec<f64> {
    let rough = (high - low) / 5.0;
    let decade = 10f64.powf(rough.log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * decade);
    let step = steps.into_iter().find(|step| *step >= rough).unwrap_or(rough);
    let (first, last) = (
        (low / step - 1e-9).ceil() as i64,
        (high / step + 1e-9).floor() as i64,
    );
    (first..=last).map(|k| k as f64 * step).collect()
}

/// A number with as many digits as its axis needs.
fn label(value: f64, span: f64) -> String {
    let digits = if span < 2.0 { 2 } else { usize::from(span < 20.0) };
    format!("{value:.digits$}")
}

fn of(reports: &[Report], quality: Quality) -> impl Iterator<Item = (usize, &Report)> {
    reports
        .iter()
        .enumerate()
        .filter(move |(_, report)| report.odometry == quality)
}

/// Distance of the car from the raceline over the way.
fn along_track(reports: &[Report], quality: Quality) -> String {
    let all = || of(reports, quality).flat_map(|(_, report)| &report.summary.along_track);
    let length = all().map(|stretch| stretch.s_m).fold(1.0, f64::max);
    let most = all()
        .map(|stretch| 100.0 * stretch.true_line_error_m)
        .fold(1.0, f64::max)
        .min(100.0);
    let titles = ["along the raceline, m", "cm"];
    let mut chart = Chart::new([980.0, 260.0], [0.0, length], [0.0, most], titles, &[]);
    for (i, report) in of(reports, quality) {
        let points = report.summary.along_track.iter();
        chart.line(
            points.map(|stretch| [stretch.s_m, (100.0 * stretch.true_line_error_m).min(most)]),
            colour(i),
        );
    }
    chart.svg()
}

/// What a strip of dots shows of a lap.
type OfLap = fn(&LapRecord) -> f64;

/// Every lap as a dot: lap time, and distance of the car from the raceline. Odometry alone would leave the others no room: its dots
/// that lie beyond theirs stand at the end.
fn distributions(reports: &[Report], quality: Quality) -> String {
    let strips: [(&str, OfLap); 2] = [
        (
            "lap time, s; odometry's slower laps stand at the right end",
            |lap| lap.time_s,
        ),
        (
            "car to line, cm; odometry's wider laps stand at the right end",
            |lap| 100.0 * lap.true_line_error_m,
        ),
    ];
    let rows = of(reports, quality).count() as f64;
    let names: Vec<(String, f64, &str)> = of(reports, quality)
        .enumerate()
        .map(|(row, (i, report))| (escaped(&report.localizer), rows - 0.5 - row as f64, colour(i)))
        .collect();
    let mut charts = String::new();
    for (title, value) in strips {
        let (least, most) = of(reports, quality)
            .filter(|(_, report)| report.localizer != "odometry")
            .flat_map(|(_, report)| &report.summary.every_lap)
            .map(value)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), v| {
                (least.min(v), most.max(v))
            });
        if !(least.is_finite() && most > least) {
            continue;
        }
        let room = 0.04 * (most - least);
        let span = [least - room, most + room];
        let mut chart = Chart::new(
            [980.0, 40.0 + 28.0 * rows],
            span,
            [0.0, rows],
            [title, ""],
            &names,
        );
        for (row, (i, report)) in of(reports, quality).enumerate() {
            let laps = &report.summary.every_lap;
            for (k, lap) in laps.iter().enumerate() {
                let height = rows - 0.2 - row as f64 - 0.6 * (k as f64 + 0.5) / laps.len() as f64;
                chart.dot([value(lap).clamp(span[0], span[1]), height], colour(i));
            }
        }
        charts += &chart.svg();
    }
    charts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn titles_are_escaped_and_labels_are_short() {
        assert_eq!(escaped("<b>&"), "&lt;b&gt;&amp;");
        assert_eq!(label(1.234, 1.0), "1.23");
        assert_eq!(label(12.34, 10.0), "12.3");
        assert_eq!(label(123.4, 100.0), "123");
        let shown = |range: [f64; 2]| -> Vec<String> {
            let span = range[1] - range[0];
            ticks(range).into_iter().map(|value| label(value, span)).collect()
        };
        assert_eq!(shown([0.0, 44.0]), ["0", "10", "20", "30", "40"]);
        assert_eq!(shown([9.161, 9.199]), ["9.17", "9.18", "9.19"]);
    }
}
