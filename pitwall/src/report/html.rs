//! The HTML page of the numbers and figures. It loads nothing: style, script and data are in it. Without the script the
//! figures of each car remain.

use super::svg::escape;
use super::{CarReport, MeanSigma, Report, figures};
use crate::fleet::SECTORS;

const STYLE: &str = "
:root { color-scheme: light dark; --text: light-dark(#131a22, #e8edf3); --quiet: light-dark(#505b68, #9aa7b6);
  --ground: light-dark(#fff, #10161d); --edge: light-dark(#d3dae3, #2a3442); --main: light-dark(#0b62c4, #5aa9ff);
  --good: light-dark(#0a7d47, #4cc38a); --warn: light-dark(#8a5200, #f5b342); --bad: light-dark(#c81e1e, #ff6b6b);
  --busy: light-dark(#0b62c4, #5aa9ff); --none: light-dark(#8f99a6, #8b95a3); --panel: light-dark(#f3f5f8, #171e27); --free: light-dark(#dde4ec, #1b232d);
  --wall: light-dark(#1d2733, #d5dde6); --line: light-dark(#93a3b5, #52657b); --on: light-dark(#0b62c4, #1c66b8); }
body { font: 15px/1.45 system-ui, sans-serif; color: var(--text); background: var(--ground); max-width: 1800px; margin: 1.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { margin-top: 2.2rem; border-bottom: 2px solid var(--edge); }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .6rem 0; }
td, th { padding: .15rem .9rem .15rem 0; text-align: right; } th { color: var(--quiet); font-weight: 400; }
td:first-child, th:first-child, .words :is(td, th) { text-align: left; } td.best { color: var(--good); font-weight: 700; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 560px), 1fr)); gap: 1rem 2rem; }
figure { margin: 0; } figcaption { color: var(--quiet); font-size: .9rem; }
svg { width: 100%; height: auto; display: block; } svg.track { max-height: 420px; }
path { fill: none; } .main { stroke: var(--main); stroke-width: 1.6; } .faint { stroke: var(--warn); stroke-width: 1; opacity: .8; }
.grid { stroke: var(--edge); } .limit { stroke: var(--bad); stroke-dasharray: 4 4; } .main-dot { fill: var(--main); } .dot.best { fill: var(--good); } .hollow { fill: none; stroke: var(--quiet); stroke-width: 1.2; }
.fill-good { fill: var(--good); } .fill-warn { fill: var(--warn); } .fill-bad { fill: var(--bad); } .fill-none { fill: var(--none); } .fill-busy { fill: var(--busy); }
.band { opacity: .75; } .mark.switch { stroke: var(--text); stroke-dasharray: 2 2; } .mark.alarm { stroke: var(--bad); stroke-width: 1.5; }
.wall { stroke: var(--wall); } .good { stroke: var(--good); } .warn { stroke: var(--warn); } .bad { stroke: var(--bad); }
text { font: 11px system-ui, sans-serif; fill: var(--quiet); } .left, .name { text-anchor: end; } .below, .in-band { text-anchor: middle; }
text.title { fill: var(--text); font-weight: 600; } text.in-band { fill: #000; } figure a { margin-left: .8rem; font-size: .85rem; color: var(--main); }
.wide { overflow-x: auto; }
@media print { figure { break-inside: avoid; } }
";

/// Drawing of laps and health, shared with the live page.
const ANALYSIS_STYLE: &str = include_str!("../web/page/analysis.css");
const ANALYSIS_SCRIPT: &str = include_str!("../web/page/analysis.js");
/// Draws the laps, and adds to each figure the links that save it.
const SCRIPT: &str = include_str!("report.js");

pub(super) fn page(report: &Report) -> String {
    let mut body = String::new();
    let file = escape(&report.file);
    body.push_str(&format!(
        "<h1>Session {file}</h1><p>{:.1} s, {} cars.</p>",
        report.duration_s,
        report.cars.len()
    ));
    for unreadable in &report.unreadable {
        body.push_str(&format!("<p>{}.</p>", escape(&unreadable.to_string())));
    }
    body.push_str(&table_one(report));
    body.push_str(&interactive(report));
    for car in &report.cars {
        body.push_str(&section(car, report.duration_s));
    }
    if !report.notes.is_empty() {
        body.push_str("<h2>Who did what</h2><ul>");
        for note in &report.notes {
            body.push_str(&format!("<li>{}</li>", escape(note)));
        }
        body.push_str("</ul>");
    }
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>{file}</title><style>{STYLE}{ANALYSIS_STYLE}</style></head><body><main>{body}</main><script type=\"module\">{ANALYSIS_SCRIPT}{SCRIPT}</script></body></html>\n"
    )
}

/// The paper's table I, from this recording.
fn table_one(report: &Report) -> String {
    let mut text = "<h2>Laps by set</h2><div class=\"wide\" tabindex=\"0\" role=\"region\" aria-label=\"laps by set\"><table><tr><th>car, set</th><th>laps</th><th>void</th><th>lap time: median [s]</th><th>middle half [s]</th><th>mean [s]</th>\
                    <th>distance from the line [cm]</th><th>alignment [%]</th><th>CPU [% of a core]</th></tr>"
        .to_owned();
    let mut rows = 0;
    for car in &report.cars {
        for row in &car.table {
            rows += 1;
            let cells = [
                row.laps.to_string(),
                row.left_out.to_string(),
                or_dash(row.quartiles_s.map(|[_, median, _]| median), 1.0, 3),
                row.quartiles_s.map_or_else(
                    || "–".to_owned(),
                    |[low, _, high]| format!("{low:.3} to {high:.3}"),
                ),
                spread(Some(row.time_s), 1.0, 3),
                spread(row.lateral_m, 100.0, 2),
                or_dash(row.alignment, 100.0, 1),
                or_dash(car.cpu, 100.0, 0),
            ];
            text.push_str(&format!(
                "<tr><td>{}, {}</td>{}</tr>",
                car.car,
                escape(&row.set),
                tds(&cells)
            ));
        }
    }
    text.push_str(
        "</table></div><p>Void laps are left out of every figure: laps in which the car stood still, was given a pose, was lost or jumped, or of which part is \
                    missing. A set without other laps shows them. Means are given with their standard deviations. Distances are those of the car's own estimate, as in table I of \
                    <i>Robustness Evaluation of Localization Techniques for Autonomous Racing</i> (arXiv 2401.07658).</p>",
    );
    if rows == 0 {
        "<p>No whole lap was driven.</p>".to_owned()
    } else {
        text
    }
}

fn section(car: &CarReport, duration_s: f64) -> String {
    let mut text = format!("<h2>{}</h2>", car.car);
    let states: Vec<String> = car
        .states
        .iter()
        .map(|(state, share)| format!("{state} {:.1} %", share * 100.0))
        .collect();
    let truth = car.truth.map_or_else(
        || "no truth recorded".to_owned(),
        |truth| {
            format!(
                "RMSE {:.2} cm (along {:.2}, across {:.2}), heading {:.3}°, at most {:.1} cm, over {} poses",
                truth.rmse_m * 100.0,
                truth.along_m * 100.0,
                truth.across_m * 100.0,
                truth.heading_rad.to_degrees(),
                truth.max_m * 100.0,
                truth.poses
            )
        },
    );
    text.push_str(&format!(
        "<p>{}. Alarms: {}. Missing messages: {}. True error: {truth}. Update p99 at most {} ms.</p>",
        if states.is_empty() {
            "No health message".to_owned()
        } else {
            states.join(", ")
        },
        car.alarms,
        car.missing,
        or_dash(car.update_p99_ms, 1.0, 2),
    ));
    text.push_str("<div class=\"figures\">");
    for figure in figures::of(car, duration_s) {
        let (svg, title) = (figure.svg, figure.title);
        // The script adds the links that save the figure.
        let data = if figure.csv.is_empty() {
            String::new()
        } else {
            format!(
                "<script type=\"text/csv\">{}</script>",
                figure.csv.replace('<', "")
            )
        };
        text.push_str(&format!(
            "<figure>{svg}<figcaption>{title}</figcaption>{data}</figure>"
        ));
    }
    text.push_str("</div>");
    text.push_str(&alarms(car));
    if !car.laps.is_empty() {
        text.push_str(&laps(car));
    }
    text
}

/// The alarms with time and place.
fn alarms(car: &CarReport) -> String {
    const MOST: usize = 200;
    if car.alarm_list.is_empty() {
        return String::new();
    }
    let mut text = "<h3>Alarms</h3><div class=\"wide\" tabindex=\"0\" role=\"region\" aria-label=\"alarms\"><table class=\"words\"><tr><th>time [s]</th><th>lap</th><th>place [m]</th><th>alarm</th></tr>".to_owned();
    for alarm in car.alarm_list.iter().take(MOST) {
        let cells = [
            alarm.lap.map_or_else(|| "–".to_owned(), |lap| lap.to_string()),
            or_dash(alarm.s_m, 1.0, 1),
            escape(&alarm.text),
        ];
        text.push_str(&format!("<tr><td>{:.1}</td>{}</tr>", alarm.at_s, tds(&cells)));
    }
    let more = car.alarm_list.len().saturating_sub(MOST);
    let more = if more > 0 {
        format!("<p>And {more} more.</p>")
    } else {
        String::new()
    };
    format!("{text}</table></div>{more}")
}

/// Laps and health over the track, drawn by the script of the page.
fn interactive(report: &Report) -> String {
    let Some((view, data)) = report.analysis.as_ref().filter(|(view, _)| !view.laps.is_empty()) else {
        return String::new();
    };
    // Nothing in the data can end the element that holds it.
    let json = |value: &dyn erased::Json| value.text().replace('<', "\\u003c");
    let data: std::collections::BTreeMap<&str, &crate::analysis::LapData> =
        data.iter().map(|(id, data)| (id.as_str(), data)).collect();
    format!(
        "<h2>Laps and health over the track</h2><div id=\"analysis\"></div>\
         <script type=\"application/json\" id=\"analysis-view\">{}</script>\
         <script type=\"application/json\" id=\"analysis-data\">{}</script>",
        json(&view),
        json(&data),
    )
}

/// JSON text of any of our own types.
mod erased {
    pub(super) trait Json {
        fn text(&self) -> String;
    }

    impl<T: serde::Serialize> Json for T {
        fn text(&self) -> String {
            serde_json::to_string(self).unwrap_or_else(|_| "null".to_owned())
        }
    }
}

fn laps(car: &CarReport) -> String {
    let least = |value: &dyn Fn(&crate::fleet::Lap) -> Option<f64>| {
        car.laps.iter().filter_map(value).min_by(f64::total_cmp)
    };
    let best = least(&|lap| lap.void.is_none().then_some(lap.time_s));
    let sectors: Vec<_> = (0..SECTORS)
        .map(|i| least(&move |lap| lap.sectors_s[i].filter(|_| lap.void.is_none())))
        .collect();
    let mut text = "<h3>Laps</h3><div class=\"wide\" tabindex=\"0\" role=\"region\" aria-label=\"laps\"><table><tr><th>lap</th><th>time [s]</th><th>to best</th><th>S1</th><th>S2</th><th>S3</th><th>set</th>\
                    <th>slipping [%]</th><th>alignment [%]</th><th>off the line [cm]</th><th>void because</th></tr>"
        .to_owned();
    for lap in &car.laps {
        let time = |value: Option<f64>, best: Option<f64>| {
            let class = if value.is_some() && value == best {
                " class=\"best\""
            } else {
                ""
            };
            format!("<td{class}>{}</td>", or_dash(value, 1.0, 3))
        };
        let cells: String = lap
            .sectors_s
            .iter()
            .zip(&sectors)
            .map(|(s, best)| time(*s, *best))
            .collect();
        let rest = [
            escape(&lap.set),
            or_dash(lap.grip.map(|grip| grip.slipping), 100.0, 0),
            or_dash(lap.grip.map(|grip| grip.alignment), 100.0, 1),
            or_dash(lap.lateral_m, 100.0, 2),
            lap.void.unwrap_or_default().to_owned(),
        ];
        text.push_str(&format!(
            "<tr><td>{}</td>{}<td>+{:.3}</td>{cells}{}</tr>",
            lap.lap,
            time(Some(lap.time_s), best.filter(|_| lap.void.is_none())),
            lap.time_s - best.unwrap_or(lap.time_s),
            tds(&rest),
        ));
    }
    text + "</table></div>"
}

fn tds(cells: &[String]) -> String {
    format!("<td>{}</td>", cells.join("</td><td>"))
}

fn spread(value: Option<MeanSigma>, scale: f64, digits: usize) -> String {
    value.map_or_else(
        || "–".to_owned(),
        |MeanSigma { mean, sigma }| format!("{:.digits$} ± {:.digits$}", mean * scale, sigma * scale),
    )
}

fn or_dash(value: Option<f64>, scale: f64, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{:.digits$}", value * scale))
}
