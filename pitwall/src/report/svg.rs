//! Plots as SVG text, with CSS classes for the colours.

/// Size of a plot \[px\].
pub(super) const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 192.0;
/// Margin for the numbers of the axes \[px\].
const LEFT: f64 = 46.0;
const BELOW: f64 = 28.0;
/// Strip for the title, so that no curve runs through it.
const ABOVE: f64 = 20.0;
/// Height of a row of bands \[px\].
const BAND: f64 = 18.0;

/// A plot of lines over one axis.
pub(super) struct Plot {
    text: String,
    /// What is drawn, for a file: a name and points.
    data: Vec<(String, Vec<[f64; 2]>)>,
    name: String,
    x: [f64; 2],
    y: [f64; 2],
}

impl Plot {
    /// A plot with the ranges `x` and `y` and the names of the axes.
    pub(super) fn new(x: [f64; 2], y: [f64; 2], names: [&str; 2]) -> Self {
        let widen = |[from, to]: [f64; 2]| if to > from { [from, to] } else { [from, from + 1.0] };
        let mut plot = Self {
            text: format!(
                r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img"><title>{} over {}</title>"#,
                escape(names[1]),
                escape(names[0])
            ),
            data: Vec::new(),
            name: names[0].to_owned(),
            x: widen(x),
            y: widen(y),
        };
        for tick in ticks(plot.y) {
            let at = plot.place([plot.x[0], tick]);
            plot.write(&format!(
                r#"<line class="grid" x1="{LEFT}" x2="{WIDTH}" y1="{y:.1}" y2="{y:.1}"/><text class="left" x="{}" y="{:.1}">{}</text>"#,
                LEFT - 5.0,
                at[1] + 4.0,
                number(tick),
                y = at[1],
            ));
        }
        for tick in ticks(plot.x) {
            let at = plot.place([tick, plot.y[0]]);
            plot.write(&format!(
                r#"<text class="below" x="{:.1}" y="{:.1}">{}</text>"#,
                at[0],
                HEIGHT - BELOW + 13.0,
                number(tick)
            ));
        }
        plot.write(&format!(
            r#"<text class="name" x="{WIDTH}" y="{}">{}</text><text class="title" x="{}" y="{}">{}</text>"#,
            HEIGHT - 2.0,
            escape(names[0]),
            LEFT,
            ABOVE - 7.0,
            escape(names[1]),
        ));
        plot
    }

    /// A line through points. It is interrupted at points that are not finite.
    pub(super) fn line(&mut self, class: &str, name: &str, points: impl IntoIterator<Item = [f64; 2]>) {
        let points: Vec<_> = points.into_iter().collect();
        let mut path = String::new();
        let mut pen = 'M';
        for &point in &points {
            if point.iter().all(|v| v.is_finite()) {
                let [x, y] = self.place(point);
                path.push_str(&format!("{pen}{x:.1} {y:.1}"));
                pen = 'L';
            } else {
                pen = 'M';
            }
        }
        self.write(&format!(
            r#"<path class="{class}" d="{path}"><title>{}</title></path>"#,
            escape(name)
        ));
        self.data.push((name.to_owned(), points));
    }

    /// Dots with tooltips. One above the axis is drawn at its end as a triangle with its value.
    pub(super) fn dots(
        &mut self,
        name: &str,
        dots: impl IntoIterator<Item = (&'static str, [f64; 2], String)>,
    ) {
        let dots: Vec<_> = dots.into_iter().collect();
        for (class, point, title) in &dots {
            let [x, y] = self.place(*point);
            let title = escape(title);
            if point[1] > self.y[1] {
                self.write(&format!(
                    r#"<path class="dot {class}" d="M{x:.1} {y:.1}l-4 8h8z"><title>{title}</title></path><text class="beside" x="{:.1}" y="{:.1}">{:.1}</text>"#,
                    x + 5.0,
                    y + 9.0,
                    point[1],
                ));
            } else {
                self.write(&format!(
                    r#"<circle class="dot {class}" cx="{x:.1}" cy="{y:.1}" r="3"><title>{title}</title></circle>"#
                ));
            }
        }
        self.data.push((
            name.to_owned(),
            dots.into_iter().map(|(_, point, _)| point).collect(),
        ));
    }

    /// Coloured bands over the whole height, with their names where there is room.
    pub(super) fn bands(&mut self, bands: impl IntoIterator<Item = (&'static str, [f64; 2], String)>) {
        let bottom = HEIGHT - BELOW;
        for (class, [from, to], name) in bands {
            let ([left, _], [right, _]) = (self.place([from, 0.0]), self.place([to, 0.0]));
            let wide = (right - left).max(0.8);
            let title = escape(&name);
            self.write(&format!(
                r#"<rect class="band {class}" x="{left:.1}" y="{:.1}" width="{wide:.1}" height="{BAND}"><title>{title}</title></rect>"#,
                bottom - BAND,
            ));
            let word = name.split([' ', ',']).next().unwrap_or_default();
            if wide > 7.0 * word.len() as f64 {
                self.write(&format!(
                    r#"<text class="in-band" x="{:.1}" y="{:.1}">{}</text>"#,
                    left + wide / 2.0,
                    bottom - BAND / 2.0 + 4.0,
                    escape(word)
                ));
            }
        }
    }

    /// Vertical marks with their names.
    pub(super) fn marks(&mut self, class: &str, marks: impl IntoIterator<Item = (f64, String)>) {
        let mut free = LEFT;
        for (x, name) in marks {
            let [x, _] = self.place([x, 0.0]);
            let title = escape(&name);
            self.write(&format!(
                r#"<line class="mark {class}" x1="{x:.1}" x2="{x:.1}" y1="{ABOVE}" y2="{:.1}"><title>{title}</title></line>"#,
                HEIGHT - BELOW
            ));
            // A name that would overprint the one before is left to the tooltip.
            if class == "switch" && x >= free {
                self.write(&format!(
                    r#"<text class="beside" x="{:.1}" y="{:.1}">{title}</text>"#,
                    x + 3.0,
                    ABOVE + 10.0
                ));
                free = x + 6.5 * name.len() as f64 + 6.0;
            }
        }
    }

    /// A horizontal line across the plot.
    pub(super) fn limit(&mut self, y: f64) {
        if (self.y[0]..=self.y[1]).contains(&y) {
            let [x0, y] = self.place([self.x[0], y]);
            self.write(&format!(
                r#"<line class="limit" x1="{x0:.1}" x2="{WIDTH}" y1="{y:.1}" y2="{y:.1}"/>"#
            ));
        }
    }

    /// The figure, and what it shows as CSV.
    pub(super) fn finish(mut self) -> (String, String) {
        self.text.push_str("</svg>");
        (self.text, csv(&self.name, &self.data))
    }

    /// Position of a point \[px\]; a point outside the axes is moved to the edge.
    fn place(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let share = |v: f64, [from, to]: [f64; 2]| ((v - from) / (to - from)).clamp(0.0, 1.0);
        [
            LEFT + share(x, self.x) * (WIDTH - LEFT),
            HEIGHT - BELOW - share(y, self.y) * (HEIGHT - BELOW - ABOVE),
        ]
    }

    fn write(&mut self, text: &str) {
        self.text.push_str(text);
    }
}

/// Lines as a table: one column for each, and a row for each place.
fn csv(axis: &str, lines: &[(String, Vec<[f64; 2]>)]) -> String {
    let mut rows: Vec<(f64, Vec<Option<f64>>)> = Vec::new();
    for (column, (_, points)) in lines.iter().enumerate() {
        for [x, y] in points.iter().filter(|[x, y]| x.is_finite() && y.is_finite()) {
            let mut values = vec![None; lines.len()];
            values[column] = Some(*y);
            rows.push((*x, values));
        }
    }
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    rows.dedup_by(|next, row| {
        let same = (next.0 - row.0).abs() < 1e-9;
        if same {
            for (into, from) in row.1.iter_mut().zip(&next.1) {
                *into = into.or(*from);
            }
        }
        same
    });
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "'"));
    let names: Vec<_> = lines.iter().map(|(name, _)| quoted(name)).collect();
    let mut text = format!("{},{}\n", quoted(axis), names.join(","));
    for (x, values) in rows {
        let values: Vec<_> = values
            .iter()
            .map(|v| v.map_or_else(String::new, |v| format!("{v:.4}")))
            .collect();
        text.push_str(&format!("{x:.3},{}\n", values.join(",")));
    }
    text
}

/// About five round numbers in a range.
fn ticks([from, to]: [f64; 2]) -> Vec<f64> {
    let raw = (to - from) / 5.0;
    let power = 10_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|m| m * power)
        .find(|step| *step >= raw)
        .unwrap_or(raw);
    let first = (from / step).ceil() as i64;
    let last = (to / step + 1e-9).floor() as i64;
    (first..=last.min(first + 20)).map(|i| i as f64 * step).collect()
}

/// A number without needless digits.
pub(super) fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Escapes a text for HTML and SVG.
pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_few() {
        assert_eq!(ticks([0.0, 2.0]), [0.0, 0.5, 1.0, 1.5, 2.0]);
        assert_eq!(ticks([8.9, 10.2]), [9.0, 9.5, 10.0]);
        for range in [[-3.0, 4000.0], [1e-7, 2e-7], [0.0, 1e9]] {
            assert!((2..=12).contains(&ticks(range).len()), "{range:?}");
        }
    }

    #[test]
    fn holes_and_values_off_the_axes_are_drawn_as_such() {
        let mut plot = Plot::new([0.0, 2.0], [0.0, 1.0], ["x", "<y>"]);
        plot.line("a", "first", [[0.0, 0.5], [1.0, f64::NAN], [2.0, 9.0]]);
        plot.line("b", "second", [[0.0, 0.25]]);
        let (text, csv) = plot.finish();
        assert!(text.contains(r#"d="M46.0 92.0M640.0 20.0""#), "{text}");
        assert_eq!(
            csv,
            "\"x\",\"first\",\"second\"\n0.000,0.5000,0.2500\n2.000,9.0000,\n"
        );
        assert!(text.contains("&lt;y&gt;") && !text.contains("NaN"));
    }
}
