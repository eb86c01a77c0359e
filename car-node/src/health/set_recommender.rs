//! Recommends a parameter set, HQ or LQ, by the quality of the odometry.

use std::collections::VecDeque;

use serde::Serialize;
use synpf::{Stamp, Update};

use super::Thresholds;

/// A set that the car recommends.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Proposal {
    /// `hq` or `lq`.
    pub set: String,
    /// Why, in words with numbers.
    pub evidence: String,
    /// Since when, on the sensors' clock.
    pub since: Stamp,
}

/// Odometry is judged over this long, about a lap of a small track \[s\].
const WINDOW: f64 = 8.0;
/// No proposal before the window is filled this far \[s\].
const ENOUGH: f64 = 3.0;
/// LQ is proposed when odometry was wrong at more than this share of the scans.
const SLIPPING: f64 = 0.20;
/// HQ is proposed below this share. The gap between the two prevents a proposal that alternates.
const GRIPPING: f64 = 0.05;
/// Slip is not judged below this speed [m/s].
const SLOWEST: f64 = 0.5;

/// Judges odometry by slip and yaw rate, update by update.
#[derive(Debug, Default)]
pub struct SetRecommender {
    /// The scans of the last seconds at which the car drove: when, and whether odometry was wrong.
    scans: VecDeque<(Stamp, bool)>,
    /// The set that suits the odometry.
    wanted: Option<Proposal>,
}

impl SetRecommender {
    /// Judges an update.
    pub fn on_update(&mut self, update: &Update, thresholds: &Thresholds) {
        if update.twist.linear_x.abs() < SLOWEST {
            return;
        }
        let wrong = update.slip.abs() > thresholds.slip
            || update.yaw_rate_residual.abs() > thresholds.yaw_rate_residual;
        self.scans.push_back((update.stamp, wrong));
        while self
            .scans
            .front()
            .is_some_and(|(stamp, _)| update.stamp.since(*stamp) > WINDOW)
        {
            self.scans.pop_front();
        }
        let (Some((first, _)), count) = (self.scans.front(), self.scans.len() as f64) else {
            return;
        };
        if update.stamp.since(*first) < ENOUGH {
            return;
        }
        let share = self.scans.iter().filter(|(_, wrong)| *wrong).count() as f64 / count;
        let set = match self.wanted.as_ref().map(|proposal| proposal.set.as_str()) {
            _ if share > SLIPPING => "lq",
            _ if share < GRIPPING => "hq",
            Some("lq") => "lq",
            Some(_) => "hq",
            None => return,
        };
        let since = self
            .wanted
            .as_ref()
            .filter(|proposal| proposal.set == set)
            .map_or(update.stamp, |proposal| proposal.since);
        self.wanted = Some(Proposal {
            set: set.into(),
            evidence: format!(
                "odometry off in {:.0} % of the last {WINDOW:.0} s (slip over {:.0} % or yaw rate by {:.1} rad/s)",
                share * 100.0,
                thresholds.slip * 100.0,
                thresholds.yaw_rate_residual
            ),
            since,
        });
    }

    /// The set to use in place of `in_force`. None when that one is right, or when it is neither `hq` nor `lq`: then somebody
    /// chose it on purpose.
    pub fn proposal(&self, in_force: &str) -> Option<&Proposal> {
        self.wanted
            .as_ref()
            .filter(|proposal| matches!(in_force, "hq" | "lq") && proposal.set != in_force)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::tests_support::good_update;

    fn drive(recommender: &mut SetRecommender, from: f64, seconds: f64, slip: impl Fn(usize) -> f64) {
        for scan in 0..(seconds * 40.0) as usize {
            let mut update = good_update(Stamp(0).plus(from + scan as f64 / 40.0), 1);
            update.twist.linear_x = 3.0;
            update.slip = slip(scan);
            recommender.on_update(&update, &Thresholds::default());
        }
    }

    #[test]
    fn slipping_calls_for_lq_and_grip_for_hq() {
        let mut recommender = SetRecommender::default();
        drive(&mut recommender, 0.0, 2.0, |_| 0.2);
        assert_eq!(recommender.proposal("hq"), None, "too early");
        drive(&mut recommender, 2.0, 3.0, |_| 0.2);
        assert_eq!(recommender.proposal("hq").expect("slips").set, "lq");
        assert_eq!(recommender.proposal("lq"), None);
        assert_eq!(recommender.proposal("my-own"), None);
        drive(&mut recommender, 5.0, 10.0, |_| 0.01);
        assert_eq!(recommender.proposal("lq").expect("grips").set, "hq");
        assert_eq!(recommender.proposal("hq"), None);
    }

    #[test]
    fn between_the_two_shares_the_proposal_stays() {
        let tenth = |scan: usize| if scan.is_multiple_of(10) { 0.2 } else { 0.0 };
        let mut recommender = SetRecommender::default();
        drive(&mut recommender, 0.0, 8.0, tenth);
        assert_eq!(recommender.proposal("hq"), None);
        assert_eq!(recommender.proposal("lq"), None);
        drive(&mut recommender, 8.0, 8.0, |_| 0.2);
        drive(&mut recommender, 16.0, 20.0, tenth);
        assert_eq!(recommender.proposal("hq").expect("still").set, "lq");
    }
}
