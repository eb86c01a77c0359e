//! A parameter set made ready: everything that takes time is done here, away from the filter's thread.

use localizer::{ParameterFault, PreparedParameters};
use maps::Pose;

use crate::parameters::Parameters;
use crate::sensor_model::SensorModel;
use crate::sensor_parameters::{RangeMethod, SensorModelKind};
use crate::table_store::{TableJob, TableKey};
use crate::track_map::{TableLayout, TrackMap};

/// A parameter set with the tables that it needs. Making one takes milliseconds, swapping it in takes none.
#[derive(Debug, Clone)]
pub struct Tuning {
    pub(crate) parameters: Parameters,
    pub(crate) sensor_model: SensorModel,
}

impl Tuning {
    /// Validates a set and builds its sensor model. Every fault is listed. The range tables are the map's and built by
    /// [`TrackMap::prepare`]; see [`Tuning::prepare`] for both at once.
    pub fn new(parameters: Parameters) -> Result<Self, Vec<ParameterFault>> {
        parameters.validate()?;
        #[cfg(feature = "gpu")]
        if parameters.sensor.range_method == RangeMethod::Gpu {
            crate::gpu::Gpu::shared().map_err(|error| vec![gpu_fault(&error)])?;
        }
        let sensor_model = SensorModel::new(&parameters);
        Ok(Self {
            parameters,
            sensor_model,
        })
    }

    /// Makes a set ready for `Localizer::set_parameters`, range tables included: those around `map_from_base_link`, or of
    /// all tracks on the map where the pose is not known.
    pub fn prepare(
        parameters: Parameters,
        map: &TrackMap,
        map_from_base_link: Option<Pose>,
    ) -> Result<PreparedParameters, Vec<ParameterFault>> {
        let tuning = Self::new(parameters)?;
        map.prepare(map_from_base_link, &tuning.parameters);
        Ok(PreparedParameters::new(tuning))
    }
}

/// A graphics card that cannot be used, as a fault of the set that asks for it.
#[cfg(feature = "gpu")]
pub(crate) fn gpu_fault(error: &crate::gpu::GpuError) -> ParameterFault {
    ParameterFault {
        key: "range_method".into(),
        fault: format!("gpu: {error}"),
    }
}

impl TrackMap {
    /// Builds the tables that a set needs in the caller's thread, whatever the policy, so that no update has to wait for
    /// them or go without: for the region around a pose in `map`, or, without one, for all that look like tracks.
    pub fn prepare(&self, map_from_base_link: Option<Pose>, parameters: &Parameters) {
        for key in self.needed_tables(map_from_base_link, parameters) {
            self.build_table(TableJob(key));
        }
    }

    /// Asks for the tables that a set needs, from a localizer's thread: builds them or makes them pending, by the policy.
    pub(crate) fn request_tables(&self, map_from_base_link: Option<Pose>, parameters: &Parameters) {
        for key in self.needed_tables(map_from_base_link, parameters) {
            self.table(key);
        }
    }

    /// The tables that a set needs; see [`TrackMap::prepare`].
    fn needed_tables(&self, map_from_base_link: Option<Pose>, parameters: &Parameters) -> Vec<TableKey> {
        if parameters.sensor.sensor_model != SensorModelKind::Beam {
            return Vec::new();
        }
        match parameters.sensor.range_method {
            RangeMethod::Lut => {
                let at = map_from_base_link.map(|pose| self.region_at(self.grid_from_map() * pose));
                let regions =
                    at.map_or_else(|| self.plausible_regions(), |region| region.into_iter().collect());
                let parameters = parameters.sensor.table_parameters();
                let key = |region| match self.layout(region) {
                    TableLayout::Table { .. } => Some(TableKey::Ranges { region, parameters }),
                    TableLayout::Cddt => Some(TableKey::Cddt),
                    TableLayout::RayMarching => None,
                };
                let mut keys: Vec<_> = regions.into_iter().filter_map(key).collect();
                // One CDDT serves all regions.
                keys.dedup();
                keys
            }
            RangeMethod::Cddt => vec![TableKey::Cddt],
            RangeMethod::RayMarching | RangeMethod::Gpu => Vec::new(),
        }
    }

    /// Memory that [`TrackMap::prepare`] needs with the same arguments \[bytes\], known before anything is built: exact for
    /// range tables, an upper bound for the CDDT, 0 for ray marching and for a graphics card, which has its own memory.
    pub fn table_bytes_for(&self, map_from_base_link: Option<Pose>, parameters: &Parameters) -> usize {
        let keys = self.needed_tables(map_from_base_link, parameters);
        keys.into_iter().map(|key| self.bytes_for(key)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track_map::tests::room;

    #[test]
    fn the_memory_of_tables_is_known_before_they_are_built() {
        let mut set = Parameters::default();
        for method in [RangeMethod::RayMarching, RangeMethod::Lut, RangeMethod::Cddt] {
            set.sensor.range_method = method;
            let map = room();
            let announced = map.table_bytes_for(None, &set);
            map.prepare(None, &set);
            let taken = map.table_bytes();
            if method == RangeMethod::Cddt {
                assert!((taken..8 * taken).contains(&announced), "{announced} for {taken}");
            } else {
                assert_eq!(announced, taken, "{method:?}");
            }
        }
    }
}
