//! Plots as SVG text, with CSS classes for the colours.

/// Size of a plot \[px\].
pub(super) const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 180.0;
/// Margin for the numbers of the axes \[px\].
const LEFT: f64 = 46.0;
const BELOW: f64 = 28.0;
const ABOVE: f64 = 8.0;

/// A plot of lines over one axis.
pub(super) struct Plot {
    text: String,
    x: [f64; 2],
    y: [f64; 2],
}

impl Plot {
    /// A plot with the ranges `x` and `y` and the names of the axes.
    pub(super) fn new(x: [f64; 2], y: [f64; 2], names: [&str; 2]) -> Self {
        let widen = |[from, to]: [f64; 2]| if to > from { [from, to] } else { [from, from + 1.0] };
        let mut plot = Self {
            text: format!(r#"<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">"#),
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
            LEFT + 4.0,
            ABOVE + 8.0,
            escape(names[1]),
        ));
        plot
    }

    /// A line through points. It is interrupted at points that are not finite.
    pub(super) fn line(&mut self, class: &str, points: impl IntoIterator<Item = [f64; 2]>) {
        let mut path = String::new();
        let mut pen = 'M';
        for point in points {
            if point.iter().all(|v| v.is_finite()) {
                let [x, y] = self.place(point);
                path.push_str(&format!("{pen}{x:.1} {y:.1}"));
                pen = 'L';
            } else {
                pen = 'M';
            }
        }
        self.write(&format!(r#"<path class="{class}" d="{path}"/>"#));
    }

    /// Bars of a `width` on the x axis from the axis to each point, with a tooltip.
    pub(super) fn bars(
        &mut self,
        width: f64,
        bars: impl IntoIterator<Item = (&'static str, [f64; 2], String)>,
    ) {
        for (class, [x, y], title) in bars {
            let [left, top] = self.place([x - width / 2.0, y]);
            let [right, bottom] = self.place([x + width / 2.0, self.y[0]]);
            self.write(&format!(
                r#"<rect class="{class}" x="{left:.1}" y="{top:.1}" width="{:.1}" height="{:.1}"><title>{}</title></rect>"#,
                (right - left).max(0.5),
                (bottom - top).max(0.0),
                escape(&title)
            ));
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

    pub(super) fn finish(mut self) -> String {
        self.text.push_str("</svg>");
        self.text
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
        plot.line("a", [[0.0, 0.5], [1.0, f64::NAN], [2.0, 9.0]]);
        let text = plot.finish();
        assert!(text.contains(r#"d="M46.0 80.0M640.0 8.0""#), "{text}");
        assert!(text.contains("&lt;y&gt;") && !text.contains("NaN"));
    }
}
