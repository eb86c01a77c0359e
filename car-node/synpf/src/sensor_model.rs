//! The sensor model: how well each particle explains the scan.
//!
//! `beam_model.rs` and `likelihood_field.rs` are the two models; `ranges.rs` has the methods that predict ranges.

use std::sync::Arc;

use maps::Pose;

use crate::TrackMap;
use crate::beam_layout::MOST_BEAMS;
use crate::beam_model::BeamModel;
use crate::likelihood_field::LikelihoodField;
use crate::parameters::Parameters;
use crate::particles::Particles;
use crate::preprocessed_scan::PreprocessedScan;
use crate::ranges::Ranges;
use crate::sensor_parameters::{RangeMethod, SensorModelKind};
use crate::track_map::TableLayout;

/// A sensor model with its tables of likelihoods; built once per parameter set, outside the filter's thread.
#[derive(Debug, Clone)]
pub(crate) enum SensorModel {
    Beam {
        model: Arc<BeamModel>,
        method: RangeMethod,
    },
    LikelihoodField(Arc<LikelihoodField>),
}

impl SensorModel {
    pub(crate) fn new(parameters: &Parameters) -> Self {
        match parameters.sensor.sensor_model {
            SensorModelKind::Beam => Self::Beam {
                model: Arc::new(BeamModel::new(&parameters.sensor)),
                method: parameters.sensor.range_method,
            },
            SensorModelKind::LikelihoodField => {
                Self::LikelihoodField(Arc::new(LikelihoodField::new(&parameters.sensor)))
            }
        }
    }

    /// What predicts the ranges in a region of the map. [`Ranges::Interim`] is to be asked for again with the next scan.
    pub(crate) fn ranges(&self, map: &TrackMap, region: Option<usize>, parameters: &Parameters) -> Ranges {
        let Self::Beam { method, .. } = self else {
            return Ranges::RayMarching;
        };
        let table = parameters.sensor.table_parameters();
        #[cfg(feature = "gpu")]
        if *method == RangeMethod::Gpu {
            return map.gpu().map_or(Ranges::RayMarching, Ranges::Gpu);
        }
        let layout = match (method, region) {
            (RangeMethod::Lut, Some(region)) => map.layout(region),
            (RangeMethod::Cddt, _) => TableLayout::Cddt,
            _ => TableLayout::RayMarching,
        };
        match (layout, region) {
            (TableLayout::Table { .. }, Some(region)) => map
                .range_table(region, table)
                .map_or(Ranges::Interim, Ranges::Table),
            (TableLayout::Cddt, _) => map.cddt().map_or(Ranges::Interim, Ranges::Cddt),
            (TableLayout::Table { .. } | TableLayout::RayMarching, _) => Ranges::RayMarching,
        }
    }

    /// Adds the scan's log-likelihood, divided by `squash_factor`, to every particle's log-weight.
    pub(crate) fn reweight(
        &self,
        particles: &mut Particles,
        scan: &PreprocessedScan,
        map: &TrackMap,
        ranges: &Ranges,
        base_link_from_laser: Pose,
    ) {
        match self {
            Self::Beam { model, .. } => {
                let beams = &scan.beams[..scan.beams.len().min(MOST_BEAMS)];
                model.reweight(particles, beams, map.field(), ranges, base_link_from_laser);
            }
            Self::LikelihoodField(model) => model.reweight(particles, scan, map.field()),
        }
    }
}
