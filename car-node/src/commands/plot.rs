//! Figures as SVG: panels with axes, units and a legend.

use std::fmt::Write as _;

/// Colours that stay apart for the colour-blind (Okabe and Ito).
pub(super) const COLOURS: [&str; 5] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00"];

/// Room around the axes of a panel: left, above, right, below [px].
const MARGIN: [f64; 4] = [62.0, 34.0, 16.0, 48.0];

/// A figure of several panels.
pub(super) struct Figure {
    size: [f64; 2],
    title: String,
    body: String,
    panels: usize,
}

/// An axis.
pub(super) struct Axis {
    /// Quantity and unit.
    title: String,
    range: [f64; 2],
    /// Decades at equal distances.
    log: bool,
}

impl Axis {
    pub(super) fn new(title: &str, range: [f64; 2]) -> Self {
        Self {
            title: title.into(),
            range,
            log: false,
        }
    }

    pub(super) fn log(title: &str, range: [f64; 2]) -> Self {
        Self {
            log: true,
            ..Self::new(title, range)
        }
    }

    /// Where a value lies, in [0, 1] within the range.
    fn share(&self, value: f64) -> f64 {
        let [low, high] = self.range;
        if self.log {
            (value.max(1e-300) / low).ln() / (high / low).ln()
        } else {
            (value - low) / (high - low)
        }
    }

    /// Values with a label, about `wanted` of them.
    fn ticks(&self, wanted: f64) -> Vec<(f64, String)> {
        let [low, high] = self.range;
        if self.log {
            let decades = low.log10().ceil() as i32..=high.log10().floor() as i32;
            return decades
                .map(|decade| {
                    let value = 10f64.powi(decade);
                    (value, format!("{value}"))
                })
                .collect();
        }
        let rough = (high - low) / wanted;
        let decade = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * decade);
        let step = step
            .into_iter()
            .find(|step| *step >= rough)
            .unwrap_or(10.0 * decade);
        let digits = (-step.log10().floor()).max(0.0) as usize;
        let first = (low / step - 1e-9).ceil() as i64;
        let last = (high / step + 1e-9).floor() as i64;
        (first..=last)
            .map(|k| {
                let value = k as f64 * step;
                (value, format!("{value:.digits$}"))
            })
            .collect()
    }
}

/// A panel while it is drawn on.
pub(super) struct Panel<'a> {
    figure: &'a mut Figure,
    /// The drawing area: left, top, width, height [px].
    area: [f64; 4],
    x: Axis,
    y: Axis,
    legend: Vec<(String, &'static str)>,
}

/// Text in XML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

impl Figure {
    pub(super) fn new(size: [f64; 2], title: &str) -> Self {
        Self {
            size,
            title: title.into(),
            body: String::new(),
            panels: 0,
        }
    }

    fn add(&mut self, part: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        self.body.write_fmt(part).ok();
        self.body.push('\n');
    }

    /// A panel in the box `left, top, width, height` [px].
    pub(super) fn panel(&mut self, place: [f64; 4], title: &str, x: Axis, y: Axis) -> Panel<'_> {
        let [left, above, right, below] = MARGIN;
        let area = [
            place[0] + left,
            place[1] + above,
            place[2] - left - right,
            place[3] - above - below,
        ];
        let [ax, ay, width, height] = area;
        let (bottom, middle) = (ay + height, ax + width / 2.0);
        let number = self.panels;
        self.panels += 1;
        self.add(format_args!(
            "<clipPath id=\"area{number}\"><rect x=\"{ax:.1}\" y=\"{ay:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"/></clipPath>\
             <text x=\"{ax:.1}\" y=\"{:.1}\" font-weight=\"600\">{}</text>",
            ay - 12.0,
            escaped(title)
        ));
        for (value, label) in x.ticks((width / 90.0).max(2.0)) {
            let at = ax + x.share(value) * width;
            self.add(format_args!(
                "<path d=\"M{at:.1} {ay:.1}V{bottom:.1}\" stroke=\"#e6e6e6\"/><text x=\"{at:.1}\" y=\"{:.1}\" \
                 text-anchor=\"middle\">{label}</text>",
                bottom + 17.0
            ));
        }
        for (value, label) in y.ticks((height / 55.0).max(2.0)) {
            let at = bottom - y.share(value) * height;
            self.add(format_args!(
                "<path d=\"M{ax:.1} {at:.1}H{:.1}\" stroke=\"#e6e6e6\"/><text x=\"{:.1}\" y=\"{:.1}\" \
                 text-anchor=\"end\">{label}</text>",
                ax + width,
                ax - 7.0,
                at + 4.0
            ));
        }
        let aside = ax - 44.0;
        let half = ay + height / 2.0;
        self.add(format_args!(
            "<rect x=\"{ax:.1}\" y=\"{ay:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill=\"none\" stroke=\"#888\"/>\
             <text x=\"{middle:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text transform=\"translate({aside:.1},{half:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>\
             <g clip-path=\"url(#area{number})\">",
            bottom + 37.0,
            escaped(&x.title),
            escaped(&y.title)
        ));
        Panel {
            figure: self,
            area,
            x,
            y,
            legend: Vec::new(),
        }
    }

    /// The whole figure.
    pub(super) fn svg(self) -> String {
        let [width, height] = self.size;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
             font-family=\"system-ui,sans-serif\" font-size=\"13\" fill=\"#222\">\n<title>{0}</title>\n\
             <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
             <text x=\"{1:.1}\" y=\"24\" font-size=\"17\" font-weight=\"600\" text-anchor=\"middle\">{0}</text>\n{2}</svg>\n",
            escaped(&self.title),
            width / 2.0,
            self.body
        )
    }
}

impl Panel<'_> {
    fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [left, top, width, height] = self.area;
        [
            left + self.x.share(x) * width,
            top + height - self.y.share(y) * height,
        ]
    }

    /// A line through points, with a style such as a dash pattern.
    pub(super) fn line(&mut self, points: &[[f64; 2]], colour: &str, width: f64, style: &str) {
        let mut path = String::new();
        for (i, point) in points.iter().enumerate() {
            let [x, y] = self.at(*point);
            let letter = if i == 0 { 'M' } else { 'L' };
            write!(path, "{letter}{x:.1} {y:.1}").ok();
        }
        self.figure.add(format_args!(
            "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\" stroke-linejoin=\"round\" {style}/>"
        ));
    }

    /// Dots of one kind, as one path.
    pub(super) fn dots(&mut self, points: &[[f64; 2]], colour: &str, size: f64, opacity: f64) {
        let mut path = String::new();
        for point in points {
            let [x, y] = self.at(*point);
            write!(path, "M{x:.1} {y:.1}h0").ok();
        }
        self.figure.add(format_args!(
            "<path d=\"{path}\" stroke=\"{colour}\" stroke-width=\"{size}\" stroke-linecap=\"round\" stroke-opacity=\"{opacity}\"/>"
        ));
    }

    /// Fills a shape.
    pub(super) fn fill(&mut self, points: &[[f64; 2]], colour: &str) {
        let corners: Vec<String> = points
            .iter()
            .map(|point| {
                let [x, y] = self.at(*point);
                format!("{x:.1},{y:.1}")
            })
            .collect();
        self.figure.add(format_args!(
            "<polygon points=\"{}\" fill=\"{colour}\"/>",
            corners.join(" ")
        ));
    }

    /// A word beside a point.
    pub(super) fn label(&mut self, point: [f64; 2], text: &str, colour: &str) {
        let [x, y] = self.at(point);
        self.figure.add(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\">{}</text>",
            x + 6.0,
            y - 6.0,
            escaped(text)
        ));
    }

    /// A line of the legend.
    pub(super) fn legend(&mut self, name: &str, colour: &'static str) {
        self.legend.push((name.into(), colour));
    }

    /// Ends the panel, with its legend in the corner at these shares of width and height.
    pub(super) fn end(self, [across, down]: [f64; 2]) {
        let [left, top, width, height] = self.area;
        self.figure.add(format_args!("</g>"));
        if self.legend.is_empty() {
            return;
        }
        let longest = self.legend.iter().map(|(name, _)| name.chars().count()).max();
        let (w, h) = (
            36.0 + 7.3 * longest.unwrap_or(0) as f64,
            10.0 + 18.0 * self.legend.len() as f64,
        );
        let (x, y) = (
            left + 8.0 + across * (width - w - 16.0),
            top + 8.0 + down * (height - h - 16.0),
        );
        self.figure.add(format_args!(
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{w:.1}\" height=\"{h:.1}\" fill=\"white\" fill-opacity=\"0.88\" stroke=\"#ccc\"/>"
        ));
        for (i, (name, colour)) in self.legend.iter().enumerate() {
            let line = y + 18.0 + 18.0 * i as f64;
            self.figure.add(format_args!(
                "<path d=\"M{:.1} {:.1}h16\" stroke=\"{colour}\" stroke-width=\"3\"/><text x=\"{:.1}\" y=\"{line:.1}\">{}</text>",
                x + 7.0,
                line - 4.0,
                x + 29.0,
                escaped(name)
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers_within_the_axis() {
        let ticks = |axis: Axis| -> Vec<String> { axis.ticks(5.0).into_iter().map(|tick| tick.1).collect() };
        assert_eq!(
            ticks(Axis::new("", [0.0, 1.0])),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
        assert_eq!(ticks(Axis::new("", [-3.0, 22.0])), ["0", "5", "10", "15", "20"]);
        assert_eq!(ticks(Axis::log("", [0.05, 20.0])), ["0.1", "1", "10"]);
    }

    #[test]
    fn text_is_escaped() {
        let mut figure = Figure::new([300.0, 200.0], "a < b");
        let axis = || Axis::new("x & y", [0.0, 1.0]);
        let mut panel = figure.panel([0.0, 30.0, 300.0, 170.0], "p", axis(), axis());
        panel.line(&[[0.0, 0.0], [1.0, 1.0]], COLOURS[0], 1.0, "");
        panel.end([0.0, 0.0]);
        let svg = figure.svg();
        assert!(svg.contains("<title>a &lt; b</title>") && svg.contains("x &amp; y"));
        assert_eq!(svg.matches("<g ").count(), svg.matches("</g>").count());
    }
}
