//! Collects the faults of a parameter set, so that it is refused whole with all of them.

use localizer::ParameterFault;

/// The faults found so far.
#[derive(Debug, Default)]
pub(crate) struct Check(pub(crate) Vec<ParameterFault>);

impl Check {
    /// `value` must be a number in `[low, high]`.
    pub(crate) fn range(&mut self, key: &str, value: f64, low: f64, high: f64) {
        self.that(key, (low..=high).contains(&value), || {
            format!("{value} is not in [{low}, {high}]")
        });
    }

    /// `condition` must hold; else `fault` says what does not.
    pub(crate) fn that(&mut self, key: &str, condition: bool, fault: impl FnOnce() -> String) {
        if !condition {
            self.0.push(ParameterFault {
                key: key.into(),
                fault: fault(),
            });
        }
    }
}
