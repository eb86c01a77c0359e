//! The noise of the motion models, under the keys of the reference's `pf2_params.yaml`.
//!
//! SynPF and the reference have the same parameters. SynPF's refer to the motion in one
//! [`crate::MotionParameters::noise_interval`], the reference's to the motion in one message of odometry.

use serde::{Deserialize, Serialize};

use crate::validation::Check;

/// Parameters of the noise of each motion model; the default is SynPF's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MotionNoise {
    /// `tum`: standard deviation of a rotation per rotation [rad/rad] (Stahl et al., IV 2019, as all of `tum`).
    pub alpha_1_tum: f64,
    /// `tum`: standard deviation of a rotation times the translation [rad m].
    pub alpha_2_tum: f64,
    /// `tum`: standard deviation of the translation per translation [m/m].
    pub alpha_3_tum: f64,
    /// `tum`: standard deviation of the translation per rotation [m/rad].
    pub alpha_4_tum: f64,
    /// `tum`: least translation that `alpha_2_tum` is divided by \[m\].
    pub lam_thresh: f64,
    /// `amcl`: variance of a rotation per squared rotation [rad^2/rad^2] (table 5.6, and AMCL's `alpha1`). The reference
    /// adds standard deviations instead of variances: there it is a standard deviation per rotation [rad/rad], and
    /// its value has to be squared for SynPF. The same applies to all four.
    pub alpha_1_amcl: f64,
    /// `amcl`: variance of a rotation per squared translation [rad^2/m^2] (AMCL's `alpha2`).
    pub alpha_2_amcl: f64,
    /// `amcl`: variance of the translation per squared translation [m^2/m^2] (AMCL's `alpha3`).
    pub alpha_3_amcl: f64,
    /// `amcl`: variance of the translation per squared rotation [m^2/rad^2] (AMCL's `alpha4`). AMCL's `alpha5` belongs to
    /// its model of omnidirectional robots.
    pub alpha_4_amcl: f64,
    /// `arc`: standard deviation of the forward motion per forward motion [m/m] (all of `arc` as in the reference's file).
    pub motion_dispersion_arc_x: f64,
    /// `arc`: standard deviation of the sideways motion per sideways motion [m/m].
    pub motion_dispersion_arc_y: f64,
    /// `arc`: standard deviation of the turn per turn [rad/rad].
    pub motion_dispersion_arc_theta: f64,
    /// `arc`: standard deviation of the sideways motion per forward motion [m/m].
    pub motion_dispersion_arc_xy: f64,
    /// `arc`: least standard deviation of the forward motion \[m\].
    pub motion_dispersion_arc_x_min: f64,
    /// `arc`: least standard deviation of the sideways motion \[m\].
    pub motion_dispersion_arc_y_min: f64,
    /// `arc`: greatest standard deviation of the sideways motion \[m\].
    pub motion_dispersion_arc_y_max: f64,
    /// `arc`: least standard deviation of the turn \[rad\].
    pub motion_dispersion_arc_theta_min: f64,
    /// `arc`: forward motion up to which `motion_dispersion_arc_xy` adds nothing \[m\].
    pub motion_dispersion_arc_xy_min_x: f64,
    /// `mit`: standard deviation of the forward motion \[m\] (all of `mit` as in MIT's particle filter). In the
    /// reference, whose name for the model is `default`, the noise is along the map's x axis.
    pub motion_dispersion_x: f64,
    /// `mit`: standard deviation of the sideways motion \[m\]; in the reference along the map's y axis.
    pub motion_dispersion_y: f64,
    /// `mit`: standard deviation of the turn \[rad\].
    pub motion_dispersion_theta: f64,
}

impl Default for MotionNoise {
    fn default() -> Self {
        Self {
            alpha_1_tum: 0.3,
            alpha_2_tum: 0.002,
            alpha_3_tum: 0.3,
            alpha_4_tum: 0.05,
            lam_thresh: 0.1,
            alpha_1_amcl: 0.25,
            alpha_2_amcl: 0.25,
            alpha_3_amcl: 0.09,
            alpha_4_amcl: 0.01,
            motion_dispersion_arc_x: 0.3,
            motion_dispersion_arc_y: 0.5,
            motion_dispersion_arc_theta: 0.5,
            motion_dispersion_arc_xy: 0.2,
            motion_dispersion_arc_x_min: 0.01,
            motion_dispersion_arc_y_min: 0.01,
            motion_dispersion_arc_y_max: 1.0,
            motion_dispersion_arc_theta_min: 0.01,
            motion_dispersion_arc_xy_min_x: 0.02,
            motion_dispersion_x: 0.05,
            motion_dispersion_y: 0.025,
            motion_dispersion_theta: 0.05,
        }
    }
}

impl MotionNoise {
    /// What the reference ships.
    pub(crate) const REFERENCE: Self = Self {
        alpha_1_tum: 0.5,
        alpha_2_tum: 0.015,
        alpha_3_tum: 1.0,
        alpha_4_tum: 0.1,
        lam_thresh: 0.1,
        alpha_1_amcl: 0.5,
        alpha_2_amcl: 0.5,
        alpha_3_amcl: 1.0,
        alpha_4_amcl: 0.1,
        motion_dispersion_arc_x: 0.8,
        motion_dispersion_arc_y: 1.0,
        motion_dispersion_arc_theta: 0.75,
        motion_dispersion_arc_xy: 1.0,
        motion_dispersion_arc_x_min: 0.01,
        motion_dispersion_arc_y_min: 0.03,
        motion_dispersion_arc_y_max: 1.0,
        motion_dispersion_arc_theta_min: 0.01,
        motion_dispersion_arc_xy_min_x: 0.10,
        motion_dispersion_x: 0.05,
        motion_dispersion_y: 0.025,
        motion_dispersion_theta: 0.25,
    };

    pub(crate) fn validate(&self, check: &mut Check) {
        for (key, value) in [
            ("alpha_1_tum", self.alpha_1_tum),
            ("alpha_2_tum", self.alpha_2_tum),
            ("alpha_3_tum", self.alpha_3_tum),
            ("alpha_4_tum", self.alpha_4_tum),
            ("alpha_1_amcl", self.alpha_1_amcl),
            ("alpha_2_amcl", self.alpha_2_amcl),
            ("alpha_3_amcl", self.alpha_3_amcl),
            ("alpha_4_amcl", self.alpha_4_amcl),
            ("motion_dispersion_arc_x", self.motion_dispersion_arc_x),
            ("motion_dispersion_arc_y", self.motion_dispersion_arc_y),
            ("motion_dispersion_arc_theta", self.motion_dispersion_arc_theta),
            ("motion_dispersion_arc_xy", self.motion_dispersion_arc_xy),
            ("motion_dispersion_arc_x_min", self.motion_dispersion_arc_x_min),
            ("motion_dispersion_arc_y_min", self.motion_dispersion_arc_y_min),
            ("motion_dispersion_arc_y_max", self.motion_dispersion_arc_y_max),
            (
                "motion_dispersion_arc_theta_min",
                self.motion_dispersion_arc_theta_min,
            ),
            (
                "motion_dispersion_arc_xy_min_x",
                self.motion_dispersion_arc_xy_min_x,
            ),
            ("motion_dispersion_x", self.motion_dispersion_x),
            ("motion_dispersion_y", self.motion_dispersion_y),
            ("motion_dispersion_theta", self.motion_dispersion_theta),
        ] {
            check.range(key, value, 0.0, 10.0);
        }
        check.range("lam_thresh", self.lam_thresh, 1e-3, 10.0);
    }
}
