//! A chart of error rates as SVG.

use std::fmt::{self, Display, Write};

/// Where the area of the curves is, in pixels.
const LEFT: f64 = 90.0;
const TOP: f64 = 50.0;
const WIDTH: f64 = 620.0;
const HEIGHT: f64 = 340.0;
/// The whole picture.
const PICTURE: (f64, f64) = (930.0, 470.0);
/// The lowest decade of the logarithmic part: 0.001 %.
const DECADES: f64 = 5.0;
/// From the line of zero to that of the lowest decade, as a part of the height.
const ZERO_BAND: f64 = 0.1;
/// Colours that can be told apart by everybody.
///
/// Source: Okabe and Ito, "Color universal design".
const COLOURS: [&str; 8] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8f8f00",
];

/// Rates over a row of settings; the settings stand at equal distances.
#[derive(Clone, Debug, Default)]
pub(crate) struct Chart {
    /// Above it.
    pub(crate) title: String,
    /// Below it.
    pub(crate) x_label: String,
    /// The settings, from left to right.
    pub(crate) ticks: Vec<String>,
    /// The curves.
    pub(crate) curves: Vec<Curve>,
}

/// One curve.
#[derive(Clone, Debug, Default)]
pub(crate) struct Curve {
    /// In the legend.
    pub(crate) name: String,
    /// Index of the setting, and rate from 0 to 1.
    pub(crate) points: Vec<(usize, f64)>,
}

impl Chart {
    fn x(&self, setting: usize) -> f64 {
        let steps = self.ticks.len().max(2) - 1;
        LEFT + WIDTH * ratio(setting, steps)
    }

    fn frame(&self, out: &mut String) -> fmt::Result {
        let (right, bottom, middle) = (LEFT + WIDTH, TOP + HEIGHT, LEFT + WIDTH / 2.0);
        text(
            out,
            (middle, 28.0),
            "font-size='16' text-anchor='middle'",
            &self.title,
        )?;
        let below = (middle, bottom + 55.0);
        text(out, below, "text-anchor='middle'", &self.x_label)?;
        let turned = format!(
            "text-anchor='middle' transform='rotate(-90 20 {})'",
            TOP + HEIGHT / 2.0
        );
        text(
            out,
            (20.0, TOP + HEIGHT / 2.0),
            &turned,
            "sequences in a wrong order",
        )?;
        for (rate, label) in [
            (0.0, "0"),
            (1e-5, "0.001 %"),
            (1e-4, "0.01 %"),
            (1e-3, "0.1 %"),
            (1e-2, "1 %"),
            (0.1, "10 %"),
            (1.0, "100 %"),
        ] {
            let at = y(rate);
            writeln!(out, "<path d='M{LEFT} {at:.1} H{right}' stroke='#dddddd'/>")?;
            text(out, (LEFT - 8.0, at + 4.0), "text-anchor='end'", label)?;
        }
        for (setting, label) in self.ticks.iter().enumerate() {
            let at = self.x(setting);
            writeln!(out, "<path d='M{at:.1} {TOP} V{bottom}' stroke='#eeeeee'/>")?;
            let low = (
                at,
                bottom
                    + 20.0
                    + if setting % 2 == 1 && self.ticks.len() > 9 {
                        13.0
                    } else {
                        0.0
                    },
            );
            text(out, low, "text-anchor='middle'", label)?;
        }
        writeln!(
            out,
            "<path d='M{LEFT} {TOP} V{bottom} H{right}' fill='none' stroke='black'/>"
        )
    }

    fn curve(&self, out: &mut String, index: usize, curve: &Curve) -> fmt::Result {
        let colour = COLOURS[index % COLOURS.len()];
        let dash = ["none", "7 3", "2 3"][index / COLOURS.len() % 3];
        let places: Vec<(f64, f64)> = curve
            .points
            .iter()
            .map(|(s, rate)| (self.x(*s), y(*rate)))
            .collect();
        let path: Vec<String> = places
            .iter()
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        let line =
            format!("fill='none' stroke='{colour}' stroke-width='2' stroke-dasharray='{dash}'");
        writeln!(out, "<polyline points='{}' {line}/>", path.join(" "))?;
        for (x, y) in places {
            mark(out, index, (x, y), colour)?;
        }
        #[expect(clippy::cast_precision_loss, reason = "a chart has few curves")]
        let row = TOP + 10.0 + 22.0 * index as f64;
        let begin = LEFT + WIDTH + 20.0;
        writeln!(out, "<path d='M{begin} {row} h26' {line}/>")?;
        mark(out, index, (begin + 13.0, row), colour)?;
        text(out, (begin + 34.0, row + 4.0), "", &curve.name)
    }
}

impl Display for Chart {
    /// Writes the whole picture.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (width, height) = PICTURE;
        let mut out = String::new();
        self.frame(&mut out)?;
        for (index, curve) in self.curves.iter().enumerate() {
            self.curve(&mut out, index, curve)?;
        }
        writeln!(
            f,
            "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' width='{width}' height='{height}' \
             font-family='sans-serif' font-size='12'>"
        )?;
        writeln!(f, "<rect width='100%' height='100%' fill='white'/>")?;
        writeln!(f, "{out}</svg>")
    }
}

/// Zero has a line of its own below the logarithm.
fn y(rate: f64) -> f64 {
    let lowest = 10_f64.powf(-DECADES);
    let share = if rate <= 0.0 {
        0.0
    } else {
        let decades = (rate.clamp(lowest, 1.0).log10() + DECADES) / DECADES;
        ZERO_BAND + (1.0 - ZERO_BAND) * decades
    };
    TOP + HEIGHT * (1.0 - share)
}

fn ratio(part: usize, whole: usize) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "a chart has few settings")]
    let ratio = part as f64 / whole as f64;
    ratio
}

/// A mark that tells curves apart without colour.
fn mark(out: &mut String, index: usize, (x, y): (f64, f64), colour: &str) -> fmt::Result {
    match index % 4 {
        0 => writeln!(
            out,
            "<circle cx='{x:.1}' cy='{y:.1}' r='4' fill='{colour}'/>"
        ),
        1 => writeln!(
            out,
            "<path d='M{x:.1} {y:.1} m-4 -4 h8 v8 h-8 z' fill='{colour}'/>"
        ),
        2 => writeln!(
            out,
            "<path d='M{x:.1} {y:.1} m0 -5 l5 9 h-10 z' fill='{colour}'/>"
        ),
        _ => writeln!(
            out,
            "<path d='M{x:.1} {y:.1} m0 -5 l5 5 l-5 5 l-5 -5 z' fill='{colour}'/>"
        ),
    }
}

fn text(out: &mut String, (x, y): (f64, f64), style: &str, words: &str) -> fmt::Result {
    let words = words.replace('&', "&amp;").replace('<', "&lt;");
    writeln!(out, "<text x='{x:.1}' y='{y:.1}' {style}>{words}</text>")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_go_down_the_picture_and_zero_has_its_own_line() {
        let rates = [1.0, 0.1, 1e-3, 1e-5, 0.0];
        let places: Vec<f64> = rates.iter().map(|rate| y(*rate)).collect();
        assert!(places.is_sorted_by(|a, b| a < b), "{places:?}");
        assert!((places[0] - TOP).abs() < 1e-9 && (places[4] - TOP - HEIGHT).abs() < 1e-9);
        assert!(
            (y(1e-9) - y(1e-5)).abs() < 1e-9,
            "what is not zero is not drawn as zero"
        );
    }

    #[test]
    fn every_name_point_and_tick_is_drawn() {
        let points = vec![(0, 0.5), (1, 0.01), (2, 0.0)];
        let curve = |name: &str| Curve {
            name: name.to_owned(),
            points: points.clone(),
        };
        let chart = Chart {
            title: "rate < offset & period".to_owned(),
            x_label: "offset".to_owned(),
            ticks: ["0", "1 ms", "10 ms"].map(str::to_owned).to_vec(),
            curves: (0..9).map(|n| curve(&format!("curve {n}"))).collect(),
        };
        let svg = chart.to_string();
        assert!(svg.contains("rate &lt; offset &amp; period"), "{svg}");
        for words in [
            "offset</text>",
            ">1 ms<",
            ">10 ms<",
            ">curve 0<",
            ">curve 8<",
            ">100 %<",
        ] {
            assert!(svg.contains(words), "{words} is missing in {svg}");
        }
        assert_eq!(svg.matches("<polyline").count(), 9);
        let marks = svg.matches("<circle").count();
        assert_eq!(
            marks,
            3 * 4,
            "three points and the legend of the curves 0, 4 and 8 are round"
        );
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
    }
}
