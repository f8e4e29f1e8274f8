//! Plots as SVG, for the documentation.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use anyhow::{Context, Result};

const SIZE: [f64; 2] = [640.0, 400.0];
/// Left, top, right, bottom.
const MARGINS: [f64; 4] = [64.0, 40.0, 176.0, 48.0];
/// Apart for eyes that see fewer colours as well (Okabe and Ito).
const COLORS: [&str; 7] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
];

/// How values become heights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Axis {
    Linear,
    Logarithmic,
}

/// Lines over a common axis.
#[derive(Clone, Debug)]
pub(crate) struct Plot {
    title: String,
    x: String,
    y: String,
    axis: Axis,
    lines: Vec<Line>,
}

#[derive(Clone, Debug)]
struct Line {
    name: String,
    dashed: bool,
    points: Vec<[f64; 2]>,
}

impl Plot {
    pub(crate) fn new(title: &str, x: &str, y: &str, axis: Axis) -> Self {
        let [title, x, y] = [title, x, y].map(str::to_owned);
        Self {
            title,
            x,
            y,
            axis,
            lines: Vec::new(),
        }
    }

    /// A line through points.
    pub(crate) fn line(mut self, name: &str, points: impl IntoIterator<Item = [f64; 2]>) -> Self {
        self.lines.push(Line {
            name: name.to_owned(),
            dashed: false,
            points: points.into_iter().collect(),
        });
        self
    }

    /// As [`Self::line`], of another's figures.
    pub(crate) fn dashed(self, name: &str, points: impl IntoIterator<Item = [f64; 2]>) -> Self {
        let mut plot = self.line(name, points);
        if let Some(line) = plot.lines.last_mut() {
            line.dashed = true;
        }
        plot
    }

    /// Writes it as `NAME.svg` into a folder.
    pub(crate) fn write(&self, folder: &Path, name: &str) -> Result<()> {
        let file = folder.join(format!("{name}.svg"));
        fs::create_dir_all(folder)
            .and_then(|()| fs::write(&file, self.svg()))
            .with_context(|| format!("cannot write {}", file.display()))
    }

    fn svg(&self) -> String {
        let [width, height] = SIZE;
        let [left, top, right, bottom] = MARGINS;
        let points = || self.lines.iter().flat_map(|line| &line.points);
        let is_drawn = |v: &f64| v.is_finite() && (self.axis == Axis::Linear || *v > 0.0);
        let ys = || points().map(|p| p[1]).filter(is_drawn);
        let [x_low, x_high] = bounds(points().map(|p| p[0]));
        let [low, high] = bounds(ys());
        let (low, high) = match self.axis {
            Axis::Linear => (0.0, (high * 1.05).max(f64::MIN_POSITIVE)),
            Axis::Logarithmic => (
                10_f64.powf(low.log10().floor()),
                10_f64.powf((high * 0.9999).log10().ceil()),
            ),
        };
        let high = match self.axis {
            Axis::Linear => high,
            Axis::Logarithmic => high.max(low * 10.0),
        };
        let share = |y: f64| match self.axis {
            Axis::Linear => (y - low) / (high - low),
            Axis::Logarithmic => (y / low).ln() / (high / low).ln(),
        };
        let at_x =
            |x: f64| left + (x - x_low) / (x_high - x_low).max(1e-9) * (width - left - right);
        let at_y = |y: f64| height - bottom - share(y) * (height - top - bottom);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
             font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
        );
        let mut text = |x: f64, y: f64, anchor: &str, extra: &str, what: &str| {
            let what = what.replace('&', "&amp;").replace('<', "&lt;");
            let _ = writeln!(
                svg,
                "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\"{extra}>{what}</text>"
            );
        };
        text(left, 22.0, "start", " font-size=\"14\"", &self.title);
        text(
            (left + width - right) / 2.0,
            height - 12.0,
            "middle",
            "",
            &self.x,
        );
        let middle = (top + height - bottom) / 2.0;
        let turned = format!(" transform=\"rotate(-90 16 {middle:.1})\"");
        text(16.0, middle, "middle", &turned, &self.y);
        let y_ticks = match self.axis {
            Axis::Linear => ticks(low, high),
            Axis::Logarithmic => decades(low, high),
        };
        for &y in &y_ticks {
            text(left - 6.0, at_y(y) + 4.0, "end", "", &label(y));
        }
        let x_ticks = ticks(x_low, x_high);
        for &x in &x_ticks {
            text(at_x(x), height - bottom + 18.0, "middle", "", &label(x));
        }
        for (index, line) in self.lines.iter().enumerate() {
            let y = top + 12.0 + 20.0 * index as f64;
            text(width - right + 40.0, y + 4.0, "start", "", &line.name);
        }
        let mut rule = |[x1, y1]: [f64; 2], [x2, y2]: [f64; 2], style: &str| {
            let _ = writeln!(
                svg,
                "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" {style}/>"
            );
        };
        for y in y_ticks {
            rule([left, at_y(y)], [width - right, at_y(y)], "stroke=\"#ddd\"");
        }
        for x in x_ticks {
            let end = height - bottom;
            rule([at_x(x), end], [at_x(x), end + 4.0], "stroke=\"#888\"");
        }
        for (index, line) in self.lines.iter().enumerate() {
            let y = top + 12.0 + 20.0 * index as f64;
            let style = style(index, line);
            rule([width - right + 10.0, y], [width - right + 34.0, y], &style);
        }
        for (index, line) in self.lines.iter().enumerate() {
            let drawn = line.points.iter().filter(|p| is_drawn(&p[1]));
            let path: Vec<_> = drawn
                .map(|p| format!("{:.1},{:.1}", at_x(p[0]), at_y(p[1])))
                .collect();
            let _ = writeln!(
                svg,
                "<polyline points=\"{}\" fill=\"none\" {}/>",
                path.join(" "),
                style(index, line)
            );
        }
        svg + "</svg>\n"
    }
}

fn style(index: usize, line: &Line) -> String {
    let color = COLORS[index % COLORS.len()];
    let dashes = if line.dashed {
        " stroke-dasharray=\"5 4\""
    } else {
        ""
    };
    format!("stroke=\"{color}\" stroke-width=\"2\"{dashes}")
}

fn bounds(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let [low, high] = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| {
        [low.min(v), high.max(v)]
    });
    if low.is_finite() {
        [low, high]
    } else {
        [1.0, 10.0]
    }
}

/// About five round values.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let rough = ((high - low) / 5.0).max(1e-9);
    let decade = 10_f64.powf(rough.log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|step| step * decade);
    let step = steps.into_iter().find(|s| *s >= rough).unwrap_or(rough);
    let first = (low / step).ceil();
    let count = ((high / step + 1e-9).floor() - first).max(0.0);
    (0..32)
        .map(f64::from)
        .take_while(|n| *n <= count)
        .map(|n| (first + n) * step)
        .collect()
}

fn decades(low: f64, high: f64) -> Vec<f64> {
    let (first, last) = (low.log10().round(), high.log10().round());
    (0..32)
        .map(|n| first + f64::from(n))
        .take_while(|n| *n <= last)
        .map(|n| 10_f64.powf(n))
        .collect()
}

fn label(value: f64) -> String {
    let rounded = format!("{value:.3}");
    let short = rounded.trim_end_matches('0').trim_end_matches('.');
    short.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 10.0), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert_eq!(ticks(1.0, 16.0), [5.0, 10.0, 15.0]);
        assert_eq!(decades(1.0, 1000.0), [1.0, 10.0, 100.0, 1000.0]);
        assert_eq!(
            [label(0.5), label(20.0), label(1000.0)],
            ["0.5", "20", "1000"]
        );
    }

    #[test]
    fn lines_end_where_their_axis_does() {
        let plot = Plot::new("a < b", "x", "y", Axis::Logarithmic)
            .line("one", [[0.0, 1.0], [10.0, 1000.0], [5.0, 0.0]])
            .dashed("two", [[0.0, 10.0], [10.0, 10.0]]);
        let svg = plot.svg();
        // The corners of the axes: 64 and 464 across, 352 and 40 down; no logarithm of 0.
        assert!(svg.contains("points=\"64.0,352.0 464.0,40.0\""), "{svg}");
        assert!(svg.contains("points=\"64.0,248.0 464.0,248.0\""), "{svg}");
        assert!(svg.contains("a &lt; b") && svg.matches("stroke-dasharray").count() == 2);
    }

    #[test]
    fn no_points_are_no_trouble() {
        let svg = Plot::new("t", "x", "y", Axis::Linear)
            .line("none", [])
            .svg();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
