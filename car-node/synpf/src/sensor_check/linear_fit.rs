//! A line fitted to pairs of rates, the older ones forgotten.

/// Sums of a weighted regression of `y` on `x`. Weights are seconds.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct LinearFit {
    weight: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
}

impl LinearFit {
    /// Adds a pair that held for `seconds`; what is older than `memory` \[s\] counts less and less.
    pub(super) fn add(&mut self, x: f64, y: f64, seconds: f64, memory: f64) {
        let keep = (-seconds / memory).exp();
        for sum in [
            &mut self.weight,
            &mut self.x,
            &mut self.y,
            &mut self.xx,
            &mut self.xy,
            &mut self.yy,
        ] {
            *sum *= keep;
        }
        self.weight += seconds;
        self.x += x * seconds;
        self.y += y * seconds;
        self.xx += x * x * seconds;
        self.xy += x * y * seconds;
        self.yy += y * y * seconds;
    }

    /// For how long pairs have come in \[s\], at most the memory.
    pub(super) fn seconds(&self) -> f64 {
        self.weight
    }

    fn per_weight(&self, sum: f64) -> f64 {
        sum / self.weight.max(1e-9)
    }

    /// Sum of the squares of `y` about its mean: how much there was to learn from.
    pub(super) fn excitation(&self) -> f64 {
        (self.yy - self.per_weight(self.y * self.y)).max(0.0)
    }

    /// The same of `x`.
    fn spread_x(&self) -> f64 {
        (self.xx - self.per_weight(self.x * self.x)).max(0.0)
    }

    fn mixed(&self) -> f64 {
        self.xy - self.per_weight(self.x * self.y)
    }

    /// Standard deviation of `x` about its mean.
    pub(super) fn deviation_x(&self) -> f64 {
        self.per_weight(self.spread_x()).sqrt()
    }

    /// The slope that fits best; None where `x` does not change.
    pub(super) fn slope(&self) -> Option<f64> {
        let spread = self.spread_x();
        (spread > 1e-9 * self.weight).then(|| self.mixed() / spread)
    }

    /// The `x` at which a line of this slope has `y` = 0: the bias of `x`.
    pub(super) fn bias(&self, slope: f64) -> f64 {
        self.per_weight(self.x) - self.per_weight(self.y) / slope
    }

    /// Share of the squares of `y` that a line of this slope leaves, with the best offset.
    pub(super) fn unexplained(&self, slope: f64) -> f64 {
        let left = self.excitation() - 2.0 * slope * self.mixed() + slope * slope * self.spread_x();
        left.max(0.0) / self.excitation().max(1e-9)
    }

    /// The same of `y` = `x`, without an offset.
    pub(super) fn unexplained_as_it_is(&self) -> f64 {
        (self.yy - 2.0 * self.xy + self.xx).max(0.0) / self.excitation().max(1e-9)
    }
}
