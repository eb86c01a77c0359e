//! The tyre: force from slip in both directions at once.

use serde::{Deserialize, Serialize};

/// A tyre pair's parameters: H. B. Pacejka, *Tire and Vehicle Dynamics*, section 4.3 (magic formula), used with the
/// combined theoretical slip of section 3.3 so that longitudinal and lateral force share one friction circle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TireParams {
    /// Stiffness factor B: the slope at small slip.
    pub stiffness: f64,
    /// Shape factor C: the force at large slip over the peak force.
    pub shape: f64,
    /// Curvature factor E: the roundness of the peak.
    pub curvature: f64,
    /// Friction coefficient at the peak and at `nominal_load`: factor D over the load.
    pub friction: f64,
    /// Load at which `friction` holds \[N\].
    pub nominal_load: f64,
    /// Share of friction lost when the load doubles.
    pub load_sensitivity: f64,
    /// Distance rolled until 63 % of a step in slip has become force \[m\].
    pub relaxation_length: f64,
}

impl TireParams {
    /// Force on the car \[N\], longitudinal and lateral, for a load \[N\] and the slip vector (dimensionless, pointing
    /// where the tread pushes the car).
    pub fn force(&self, load: f64, slip: [f64; 2]) -> [f64; 2] {
        let magnitude = slip[0].hypot(slip[1]);
        if load <= 0.0 || magnitude < 1e-12 {
            return [0.0; 2];
        }
        let force = self.peak(load) * self.normalised(magnitude) / magnitude;
        slip.map(|component| component * force)
    }

    /// Greatest force at a load \[N\].
    pub fn peak(&self, load: f64) -> f64 {
        let overload = load / self.nominal_load - 1.0;
        // A tyre far beyond its nominal load keeps some grip.
        self.friction * (1.0 - self.load_sensitivity * overload).max(0.3) * load
    }

    /// Force per slip at small slip \[N\].
    pub fn linear_stiffness(&self, load: f64) -> f64 {
        self.peak(load) * self.stiffness * self.shape
    }

    /// Slip at which the force is greatest.
    pub fn peak_slip(&self) -> f64 {
        // The formula is unimodal for E < 1: a ternary search over all slips that matter.
        let (mut low, mut high) = (0.0, 2.0);
        for _ in 0..60 {
            let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
            if self.normalised(a) < self.normalised(b) {
                low = a;
            } else {
                high = b;
            }
        }
        f64::midpoint(low, high)
    }

    /// The signed slip below the peak that makes `force` \[N\] at `load` \[N\]. For a force beyond the peak, the slip of the
    /// peak.
    pub fn slip_for(&self, load: f64, force: f64) -> f64 {
        let share = (force / self.peak(load)).abs();
        let (mut low, mut high) = (0.0, self.peak_slip());
        for _ in 0..50 {
            let middle = f64::midpoint(low, high);
            if self.normalised(middle) < share {
                low = middle;
            } else {
                high = middle;
            }
        }
        f64::midpoint(low, high).copysign(force)
    }

    /// The magic formula over its peak: in \[-1, 1\].
    fn normalised(&self, slip: f64) -> f64 {
        let steep = self.stiffness * slip;
        (self.shape * (steep - self.curvature * (steep - steep.atan())).atan()).sin()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::VehicleParams;
    use proptest::prelude::*;

    fn tire() -> TireParams {
        VehicleParams::default().front_tires
    }

    #[test]
    fn small_slip_gives_the_linear_stiffness() {
        let [x, y] = tire().force(17.0, [1e-6, 0.0]);
        assert!((x / 1e-6 / tire().linear_stiffness(17.0) - 1.0).abs() < 1e-6);
        assert!(y.abs() < 1e-12);
    }

    #[test]
    fn the_peak_is_where_the_search_says() {
        let slip = tire().peak_slip();
        let [x, _] = tire().force(17.0, [slip, 0.0]);
        assert!((x / tire().peak(17.0) - 1.0).abs() < 1e-9);
        assert!((0.1..0.6).contains(&slip), "{slip}");
    }

    #[test]
    fn braking_takes_away_from_cornering() {
        let [_, free] = tire().force(17.0, [0.0, 0.1]);
        let [_, braked] = tire().force(17.0, [-0.3, 0.1]);
        assert!(braked < 0.6 * free);
    }

    proptest! {
        #[test]
        fn force_never_leaves_the_friction_circle(load in 0.1..60.0, x in -2.0..2.0, y in -2.0..2.0) {
            let [fx, fy] = tire().force(load, [x, y]);
            prop_assert!(fx.hypot(fy) <= tire().peak(load) * (1.0 + 1e-12));
        }

        #[test]
        fn slip_undoes_force(load in 5.0..40.0, share in -0.99..0.99) {
            let force = share * tire().peak(load);
            let [_, back] = tire().force(load, [0.0, tire().slip_for(load, force)]);
            prop_assert!((back - force).abs() < 1e-6 * tire().peak(load));
        }
    }
}
