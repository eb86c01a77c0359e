//! The results of all runs over one drive.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Serialize;

use super::catalogue::{Defect, DefectKind, Grade};
use super::verdict::{Measured, Verdict};
use crate::statistics::mean;

/// What poses are compared with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum TruthFrom {
    /// True poses in the bag, or beside it.
    Bag,
    /// The poses of the same set over the undamaged log. Their own error is not known.
    UndamagedRun,
}

impl TruthFrom {
    /// What it is, in words.
    pub fn text(self) -> &'static str {
        match self {
            Self::Bag => "compared with the truth in the bag",
            Self::UndamagedRun => {
                "compared with the set's own undamaged run, because the bag has no truth: an error of that run is not seen"
            }
        }
    }
}

/// One set under one defect, over all seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The kind of the defect.
    pub defect: DefectKind,
    /// Its grade.
    pub grade: Grade,
    /// Its size with the unit; empty for a defect without grades.
    pub size: String,
    /// Mean of the position RMSE over the seeds \[m\]; None where it did not run, or gave no pose.
    pub rmse_m: Option<f64>,
    /// Largest position error of all seeds \[m\].
    pub max_m: Option<f64>,
    /// Largest heading error of all seeds \[rad\].
    pub heading_max_rad: Option<f64>,
    /// Share of the updates that are LOCALIZED.
    pub localized: Option<f64>,
    /// Of the LOCALIZED updates, the share within 0.3 m and 5 deg of the truth.
    pub precision: Option<f64>,
    /// How often a right pose was given up, over all seeds.
    pub given_up: usize,
    /// The worst verdict of all seeds; None where the defect does not apply.
    pub verdict: Option<Verdict>,
    /// Why the defect does not apply to the drive.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub not_applicable: Option<String>,
    /// Each seed's run, in the order of the seeds; None for a run without a pose.
    pub runs: Vec<Option<Measured>>,
}

impl Row {
    /// The row of a defect from its runs.
    pub fn of_runs(defect: Defect, runs: Vec<Option<Measured>>) -> Self {
        let all =
            |of: fn(&Measured) -> Option<f64>| -> Vec<f64> { runs.iter().flatten().filter_map(of).collect() };
        let verdict = |run: &Option<Measured>| run.map_or(Verdict::NoPose, |run| run.verdict);
        Self {
            rmse_m: mean(&all(|run| Some(run.rmse_m))),
            max_m: all(|run| Some(run.max_m)).into_iter().reduce(f64::max),
            heading_max_rad: all(|run| Some(run.heading_max_rad)).into_iter().reduce(f64::max),
            localized: mean(&all(|run| Some(run.localized))),
            precision: mean(&all(|run| run.precision)),
            given_up: runs.iter().flatten().map(|run| run.given_up).sum(),
            verdict: runs.iter().map(verdict).max(),
            not_applicable: None,
            runs,
            defect: defect.kind,
            grade: defect.grade,
            size: defect.size_text(),
        }
    }

    /// The row of a defect that does not apply.
    pub fn not_applicable(defect: Defect, reason: String) -> Self {
        Self {
            not_applicable: Some(reason),
            verdict: None,
            ..Self::of_runs(defect, Vec::new())
        }
    }
}

/// Up to which grade a set holds under a kind of defect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Limit {
    /// The kind.
    pub defect: DefectKind,
    /// The last grade before the first that does not hold; None if it does not hold in the mildest grade that was tried.
    pub holds_to: Option<Grade>,
    /// The first grade that does not hold, with its verdict; None if it holds in all that were tried.
    pub first_failure: Option<(Grade, Verdict)>,
}

/// All results of one set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SetReport {
    /// The set's name.
    pub set: String,
    /// What poses are compared with.
    pub truth: TruthFrom,
    /// The part of the log that was run \[s\].
    pub duration_s: f64,
    /// Over the log as it is: each seed's run.
    pub undamaged: Vec<Option<Measured>>,
    /// The rows in the order of the catalogue.
    pub rows: Vec<Row>,
}

impl SetReport {
    /// The limits of the set, by kind, in the order of the rows. Kinds that do not apply are left out.
    pub fn limits(&self) -> Vec<Limit> {
        let mut limits: Vec<Limit> = Vec::new();
        for row in &self.rows {
            let Some(verdict) = row.verdict else { continue };
            if limits.last().is_none_or(|limit| limit.defect != row.defect) {
                limits.push(Limit {
                    defect: row.defect,
                    holds_to: None,
                    first_failure: None,
                });
            }
            if let Some(limit) = limits.last_mut()
                && limit.first_failure.is_none()
            {
                match verdict {
                    Verdict::Holds => limit.holds_to = Some(row.grade),
                    _ => limit.first_failure = Some((row.grade, verdict)),
                }
            }
        }
        limits
    }

    /// How many rows have each verdict, best first.
    pub fn counts(&self) -> BTreeMap<Verdict, usize> {
        let mut counts = BTreeMap::new();
        for verdict in self.rows.iter().filter_map(|row| row.verdict) {
            *counts.entry(verdict).or_default() += 1;
        }
        counts
    }

    /// Mean RMSE of the undamaged runs \[m\], and their largest error \[m\].
    pub fn undamaged_error(&self) -> Option<[f64; 2]> {
        let runs: Vec<&Measured> = self.undamaged.iter().flatten().collect();
        let rmse = mean(&runs.iter().map(|run| run.rmse_m).collect::<Vec<_>>())?;
        let max = runs.iter().map(|run| run.max_m).fold(0.0, f64::max);
        Some([rmse, max])
    }
}

/// All results over one bag.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The bag.
    pub bag: PathBuf,
    /// The map.
    pub map: PathBuf,
    /// The seeds.
    pub seeds: Vec<u64>,
    /// The sets, in the order in which they were given.
    pub sets: Vec<SetReport>,
}

impl Report {
    /// The report as an HTML page that loads nothing and has no script.
    pub fn to_html(&self) -> String {
        super::html::page(self)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) fn measured(verdict: Verdict) -> Measured {
        Measured {
            rmse_m: 0.02,
            max_m: 0.1,
            heading_rmse_rad: 0.01,
            heading_max_rad: 0.03,
            localized: 0.95,
            precision: Some(1.0),
            right: 1.0,
            misleading: 0.0,
            given_up: 0,
            right_at_end: true,
            updates: 100,
            verdict,
        }
    }

    fn row(text: &str, verdict: Verdict) -> Row {
        let defect = text.parse::<super::super::DefectChoice>().expect(text).one();
        Row::of_runs(
            defect,
            vec![Some(measured(Verdict::Holds)), Some(measured(verdict))],
        )
    }

    pub(in super::super) fn report() -> Report {
        let gyro = Defect {
            kind: DefectKind::GyroNone,
            grade: Grade::Medium,
        };
        Report {
            bag: "a <drive>.mcap".into(),
            map: "map.yaml".into(),
            seeds: vec![0, 1],
            sets: vec![SetReport {
                set: "hq".into(),
                truth: TruthFrom::UndamagedRun,
                duration_s: 40.0,
                undamaged: vec![Some(measured(Verdict::Holds)); 2],
                rows: vec![
                    row("people:mild", Verdict::Holds),
                    row("people:medium", Verdict::Misleads),
                    row("people:severe", Verdict::Holds),
                    row("twist-zero", Verdict::Holds),
                    Row::not_applicable(gyro, "the log has no gyroscope".into()),
                ],
            }],
        }
    }

    #[test]
    fn a_set_holds_up_to_the_grade_before_the_first_that_fails() {
        let report = report();
        let limits = report.sets[0].limits();
        let expected = [
            Limit {
                defect: DefectKind::People,
                holds_to: Some(Grade::Mild),
                first_failure: Some((Grade::Medium, Verdict::Misleads)),
            },
            Limit {
                defect: DefectKind::TwistZero,
                holds_to: Some(Grade::Medium),
                first_failure: None,
            },
        ];
        assert_eq!(limits, expected);
        let counts: Vec<_> = report.sets[0].counts().into_iter().collect();
        assert_eq!(counts, [(Verdict::Holds, 3), (Verdict::Misleads, 1)]);
    }

    #[test]
    fn a_row_has_the_worst_of_its_seeds() {
        let none = Row::of_runs(
            Defect {
                kind: DefectKind::Cars,
                grade: Grade::Mild,
            },
            vec![Some(measured(Verdict::Holds)), None],
        );
        assert_eq!(none.verdict, Some(Verdict::NoPose));
        assert_eq!(none.rmse_m, Some(0.02));
    }
}
