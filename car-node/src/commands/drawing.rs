//! Pictures of a track: dots for the terminal, SVG for everything else.

use std::fmt::Write;

use maps::RacelinePoint;
use simulator::{Surface, Track};

/// The track in Braille dots, `columns` characters wide: walls as dots, the raceline as every other one.
pub(crate) fn terminal(track: &Track, columns: usize) -> String {
    let [low, high] = extent(track);
    let size = [high[0] - low[0], high[1] - low[1]];
    // A character is two dots wide and four high, and about twice as high as wide: dots are square.
    let per_metre = (2 * columns - 1) as f64 / size[0];
    let rows = ((size[1] * per_metre) as usize / 4 + 1).max(1);
    let mut dots = vec![0_u8; columns * rows];
    let mut set = |x: f64, y: f64| {
        let (u, v) = (
            ((x - low[0]) * per_metre) as usize,
            ((high[1] - y) * per_metre) as usize,
        );
        // Unicode numbers the dots 1 2 3 7 down the left column and 4 5 6 8 down the right one.
        let bit = [[0, 1, 2, 6], [3, 4, 5, 7]][u % 2][v % 4];
        if let Some(cell) = dots.get_mut(v / 4 * columns + u / 2).filter(|_| u / 2 < columns) {
            *cell |= 1 << bit;
        }
    };
    for wall in track.walls.polylines() {
        for pair in wall.points.windows(2) {
            let ([x0, y0], [x1, y1]) = (pair[0], pair[1]);
            let steps = ((x1 - x0).hypot(y1 - y0) * per_metre * 2.0).ceil().max(1.0) as usize;
            for step in 0..=steps {
                let t = step as f64 / steps as f64;
                set(x0 + t * (x1 - x0), y0 + t * (y1 - y0));
            }
        }
    }
    let gap = 4.0 / per_metre;
    for i in 0..(track.raceline.length() / gap) as usize {
        let p = track.raceline.at(i as f64 * gap);
        set(p.x, p.y);
    }
    let mut text = String::new();
    for row in dots.chunks_exact(columns) {
        let line: String = row
            .iter()
            .map(|&dots| char::from_u32(0x2800 + u32::from(dots)).unwrap_or(' '))
            .collect();
        text.push_str(line.trim_end_matches('\u{2800}'));
        text.push('\n');
    }
    let start = track.raceline.at(0.0);
    writeln!(
        text,
        "{}: {:.1} m a lap, {:.1} x {:.1} m; the dotted line is the raceline, from ({:.2}, {:.2})",
        track.name,
        track.raceline.length(),
        size[0],
        size[1],
        start.x,
        start.y
    )
    .expect("a string takes all");
    text
}

/// The track as SVG: metres as units, walls black (black tubes dashed), the raceline from blue (slow) to red (fast).
pub(crate) fn svg(track: &Track) -> String {
    let [low, high] = extent(track);
    let size = [high[0] - low[0], high[1] - low[1]];
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"{:.3} {:.3} {:.3} {:.3}\" width=\"{:.0}\" \
         height=\"{:.0}\">\n<title>{}</title>\n<rect x=\"{:.3}\" y=\"{:.3}\" width=\"100%\" height=\"100%\" \
         fill=\"white\"/>\n<g transform=\"scale(1,-1)\" fill=\"none\" stroke-linecap=\"round\">\n",
        low[0],
        -high[1],
        size[0],
        size[1],
        40.0 * size[0],
        40.0 * size[1],
        escaped(&track.name),
        low[0],
        -high[1],
    );
    let mut add = |text: String| svg.push_str(&text);
    for wall in track.walls.polylines() {
        let points: Vec<String> = wall
            .points
            .iter()
            .map(|[x, y]| format!("{x:.3},{y:.3}"))
            .collect();
        let dash = match wall.surface {
            Surface::Plain => "",
            Surface::Black => " stroke-dasharray=\"0.1 0.1\"",
        };
        add(format!(
            "<polyline points=\"{}\" stroke=\"black\" stroke-width=\"0.05\"{dash}/>\n",
            points.join(" ")
        ));
    }
    let line = &track.raceline;
    let speeds = line.points().iter().map(|p| p.speed);
    let slowest = speeds.clone().fold(f64::INFINITY, f64::min);
    let fastest = speeds.fold(0.0, f64::max);
    let span = (fastest - slowest).max(1e-9);
    let count = (line.length() / 0.25).ceil() as usize;
    let at = |i: usize| -> RacelinePoint { line.at(i as f64 * line.length() / count as f64) };
    for i in 0..count {
        let (a, b) = (at(i), at(i + 1));
        let hue = 240.0 * (1.0 - (a.speed - slowest) / span);
        add(format!(
            "<line x1=\"{:.3}\" y1=\"{:.3}\" x2=\"{:.3}\" y2=\"{:.3}\" stroke=\"hsl({hue:.0} 90% 45%)\" \
             stroke-width=\"0.07\"/>\n",
            a.x, a.y, b.x, b.y
        ));
    }
    let start = line.at(0.0);
    let (sin, cos) = start.heading.sin_cos();
    add(format!(
        "<line x1=\"{:.3}\" y1=\"{:.3}\" x2=\"{:.3}\" y2=\"{:.3}\" stroke=\"green\" stroke-width=\"0.08\"/>\n",
        start.x + 0.4 * sin,
        start.y - 0.4 * cos,
        start.x - 0.4 * sin,
        start.y + 0.4 * cos
    ));
    add("</g>\n</svg>\n".to_owned());
    svg
}

/// Corners of the box around walls and raceline, with a little room \[m\].
fn extent(track: &Track) -> [[f64; 2]; 2] {
    let line = track.raceline.points().iter().map(|p| [p.x, p.y]);
    let walls = track
        .walls
        .polylines()
        .iter()
        .flat_map(|wall| wall.points.iter().copied());
    let empty = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
    let [low, high] = line.chain(walls).fold(empty, |[low, high], p| {
        [
            [low[0].min(p[0]), low[1].min(p[1])],
            [high[0].max(p[0]), high[1].max(p[1])],
        ]
    });
    [low.map(|v| v - 0.2), high.map(|v| v + 0.2)]
}

/// Text in XML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drawing_is_as_wide_as_it_was_asked_to_be() {
        let track = Track::bundled("club").expect("it ships");
        let text = terminal(&track, 60);
        let widest = text
            .lines()
            .filter(|line| line.starts_with(|c: char| ('\u{2800}'..='\u{28ff}').contains(&c)))
            .map(|line| line.chars().count())
            .max();
        assert!((58..=60).contains(&widest.expect("some lines")));
    }

    #[test]
    fn an_svg_has_every_wall_and_its_name() {
        let mut track = Track::bundled("club").expect("it ships");
        track.name = "a < b".into();
        let svg = svg(&track);
        assert_eq!(svg.matches("<polyline").count(), track.walls.polylines().len());
        assert!(svg.contains("<title>a &lt; b</title>") && svg.ends_with("</svg>\n"));
    }
}
