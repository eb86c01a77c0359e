//! The report as one HTML page. It has no script and loads nothing.

use std::fmt::Write;

use super::catalogue::{DefectKind, Grade};
use super::report::{Report, Row, SetReport};
use super::verdict::Verdict;

const STYLE: &str = "
:root { color-scheme: light dark; --text: light-dark(#131a22, #e8edf3); --quiet: light-dark(#505b68, #9aa7b6);
  --ground: light-dark(#fff, #10161d); --edge: light-dark(#d3dae3, #2a3442);
  --holds: light-dark(#0a7d47, #4cc38a); --doubts: light-dark(#4f7a0c, #a3c644); --warns: light-dark(#b86e00, #f5b342);
  --gives-up: light-dark(#b3420b, #ff9152); --misleads: light-dark(#c81e1e, #ff6b6b); --no-pose: light-dark(#7a1fa2, #cf8df0); }
body { font: 15px/1.45 system-ui, sans-serif; color: var(--text); background: var(--ground); max-width: 1180px; margin: 1.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { margin-top: 2.2rem; border-bottom: 2px solid var(--edge); }
p, dd { color: var(--quiet); } dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: 0; } dd { margin: 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }
td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; } th { color: var(--quiet); font-weight: 400; }
tr.part td { padding-top: 1rem; font-weight: 600; } tr.kind { border-top: 1px solid var(--edge); } td small { color: var(--quiet); display: block; }
td.plot { width: 330px; padding: 0; } svg { display: block; width: 330px; height: auto; }
text { font: 11px system-ui, sans-serif; fill: var(--quiet); text-anchor: middle; } .grid { stroke: var(--edge); } .limit { stroke: var(--quiet); stroke-dasharray: 3 3; }
b { font-weight: 600; } .holds { color: var(--holds); } .doubts { color: var(--doubts); } .warns { color: var(--warns); }
.gives-up { color: var(--gives-up); } .misleads { color: var(--misleads); } .no-pose { color: var(--no-pose); }
@media print { tr { break-inside: avoid; } }
";

/// The plots' axis: errors from 1 mm to 100 m on a logarithmic scale.
const WIDTH: f64 = 330.0;
const DECADES: [f64; 2] = [-3.0, 2.0];
/// Height of a row of a plot.
const ROW: f64 = 16.0;

pub(super) fn page(report: &Report) -> String {
    let bag = escape(&report.bag.display().to_string());
    let map = escape(&report.map.display().to_string());
    let seeds: Vec<_> = report.seeds.iter().map(ToString::to_string).collect();
    let mut body = format!(
        "<h1>Where the localizer holds: {bag}</h1><p>Map {map}; seeds {}. Each row is the log with one defect. The plots show the \
         position error on a logarithmic scale, from its RMSE to its maximum; the dashed line is at 0.3 m, up to which a pose counts \
         as right. The heading is its largest error.</p><dl>",
        seeds.join(", ")
    );
    for verdict in Verdict::ALL {
        add(
            &mut body,
            format_args!(
                "<dt>{}</dt><dd>{}</dd>",
                coloured(verdict),
                escape(verdict.meaning())
            ),
        );
    }
    body.push_str("</dl>");
    for set in &report.sets {
        body.push_str(&section(set));
    }
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>stress: {bag}</title><style>{STYLE}</style></head><body>{body}</body></html>\n"
    )
}

fn section(set: &SetReport) -> String {
    let mut text = format!("<h2>Set {}</h2>", escape(&set.set));
    let undamaged = set.undamaged_error().map_or_else(
        || "no pose".to_owned(),
        |[rmse, max]| format!("RMSE {}, at most {}", length(rmse), length(max)),
    );
    let counts: Vec<String> = set
        .counts()
        .into_iter()
        .map(|(verdict, count)| format!("{} {count}", coloured(verdict)))
        .collect();
    add(
        &mut text,
        format_args!(
            "<p>{:.0} s, {}. Undamaged: {undamaged}.</p><p>Of {} defects and grades: {}.</p>",
            set.duration_s,
            escape(set.truth.text()),
            set.rows.iter().filter(|row| row.verdict.is_some()).count(),
            counts.join(", ")
        ),
    );
    text.push_str("<table><tr><th>defect</th><th>grade</th><th>heading</th><th>LOCALIZED</th><th>precision</th><th>given up</th><th>verdict</th>");
    add(&mut text, format_args!("<th>{}</th></tr>", axis()));
    let mut part = None;
    for rows in set.rows.chunk_by(|a, b| a.defect == b.defect) {
        let Some(first) = rows.first() else { continue };
        if part != Some(first.defect.part()) {
            part = Some(first.defect.part());
            add(
                &mut text,
                format_args!(
                    "<tr class=\"part\"><td colspan=\"8\">{}</td></tr>",
                    first.defect.part()
                ),
            );
        }
        text.push_str(&kind(first.defect, rows));
    }
    text + "</table>"
}

/// The rows of one kind of defect.
fn kind(kind: DefectKind, rows: &[Row]) -> String {
    let mut text = String::new();
    for (index, row) in rows.iter().enumerate() {
        let class = if index == 0 { " class=\"kind\"" } else { "" };
        add(&mut text, format_args!("<tr{class}>"));
        if index == 0 {
            add(
                &mut text,
                format_args!(
                    "<td rowspan=\"{}\">{}<small>{}</small></td>",
                    rows.len(),
                    kind.name(),
                    escape(kind.text())
                ),
            );
        }
        let grade = match (row.size.as_str(), row.grade) {
            ("", Grade::Medium) => String::new(),
            (size, grade) => format!("{grade} <small>{}</small>", escape(size)),
        };
        match (&row.not_applicable, row.verdict) {
            (Some(reason), _) => add(
                &mut text,
                format_args!(
                    "<td>{grade}</td><td colspan=\"6\">does not apply: {}</td>",
                    escape(reason)
                ),
            ),
            (None, Some(verdict)) => {
                let percent = |share: Option<f64>| {
                    share.map_or_else(|| "–".to_owned(), |share| format!("{:.1} %", share * 100.0))
                };
                add(
                    &mut text,
                    format_args!(
                        "<td>{grade}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td class=\"plot\">{}</td>",
                        row.heading_max_rad
                            .map_or_else(|| "–".to_owned(), |angle| format!("{:.1}°", angle.to_degrees())),
                        percent(row.localized),
                        percent(row.precision),
                        row.given_up,
                        coloured(verdict),
                        plot(row, verdict)
                    ),
                );
            }
            (None, None) => {}
        }
        text.push_str("</tr>");
    }
    text
}

/// Where an error is on the axis.
fn place(error: f64) -> f64 {
    let [low, high] = DECADES;
    // A NaN is drawn at the end.
    let decade = if error.is_nan() {
        high
    } else {
        error.max(1e-9).log10().clamp(low, high)
    };
    8.0 + (WIDTH - 16.0) * (decade - low) / (high - low)
}

fn axis() -> String {
    let marks = [
        (0.001, "1 mm"),
        (0.01, "1 cm"),
        (0.1, "10 cm"),
        (1.0, "1 m"),
        (10.0, "10 m"),
    ];
    let mut text = format!("<svg viewBox=\"0 0 {WIDTH} {ROW}\">");
    for (error, name) in marks {
        let x = place(error).max(16.0);
        add(
            &mut text,
            format_args!("<text x=\"{x:.1}\" y=\"12\">{name}</text>"),
        );
    }
    text + "</svg>"
}

/// The error from its RMSE to its maximum.
fn plot(row: &Row, verdict: Verdict) -> String {
    let mut text = format!("<svg viewBox=\"0 0 {WIDTH} {ROW}\" class=\"{}\">", class(verdict));
    for error in [0.001, 0.01, 0.1, 1.0, 10.0, 100.0] {
        add(
            &mut text,
            format_args!(
                "<line class=\"grid\" x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"0\" y2=\"{ROW}\"/>",
                place(error)
            ),
        );
    }
    add(
        &mut text,
        format_args!(
            "<line class=\"limit\" x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"0\" y2=\"{ROW}\"/>",
            place(super::verdict::RIGHT_POSITION)
        ),
    );
    if let (Some(rmse), Some(max)) = (row.rmse_m, row.max_m) {
        add(
            &mut text,
            format_args!(
                "<title>RMSE {}, at most {}</title><line x1=\"{:.1}\" x2=\"{:.1}\" y1=\"8\" y2=\"8\" stroke=\"currentColor\" \
                 stroke-width=\"4\"/><circle cx=\"{:.1}\" cy=\"8\" r=\"5\" fill=\"currentColor\"/>",
                length(rmse),
                length(max),
                place(rmse),
                place(max),
                place(rmse)
            ),
        );
    }
    text + "</svg>"
}

/// A length in the unit that suits it.
fn length(metres: f64) -> String {
    match metres {
        m if m < 0.01 => format!("{:.1} mm", m * 1e3),
        m if m < 1.0 => format!("{:.1} cm", m * 100.0),
        m => format!("{m:.1} m"),
    }
}

fn class(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Holds => "holds",
        Verdict::Doubts => "doubts",
        Verdict::Warns => "warns",
        Verdict::GivesUp => "gives-up",
        Verdict::Misleads => "misleads",
        Verdict::NoPose => "no-pose",
    }
}

fn coloured(verdict: Verdict) -> String {
    format!("<b class=\"{}\">{verdict}</b>", class(verdict))
}

/// Adds to a text. Writing to a string does not fail.
fn add(text: &mut String, more: std::fmt::Arguments<'_>) {
    text.write_fmt(more).ok();
}

/// Text in HTML.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_stands_alone_and_has_every_row() {
        let page = super::super::report::tests::report().to_html();
        assert!(page.contains("a &lt;drive&gt;.mcap") && !page.contains("<drive>"));
        assert!(page.contains("does not apply: the log has no gyroscope"));
        assert!(page.contains("because the bag has no truth"));
        assert_eq!(page.matches("<circle").count(), 4);
        for foreign in ["http:", "https:", "<script", "src="] {
            assert!(!page.contains(foreign), "{foreign}");
        }
    }

    #[test]
    fn errors_have_places_from_left_to_right_whatever_they_are() {
        let errors = [0.0, 1e-4, 1e-3, 0.3, 5.0, 1e5, f64::NAN];
        let places = errors.map(place);
        assert!(places.is_sorted(), "{places:?}");
        assert!(places.iter().all(|x| (0.0..=WIDTH).contains(x)));
    }
}
