//! A parameter set made ready: everything that takes time is done here, away from the filter's thread.

use localizer::{ParameterFault, PreparedParameters};
use maps::Pose;

use crate::parameters::Parameters;
use crate::sensor_model::RangeMethod;
use crate::sensor_model::SensorModel;
use crate::track_map::TrackMap;

/// A parameter set with the tables that it needs. Making one takes milliseconds, swapping it in takes none.
#[derive(Debug, Clone)]
pub struct Tuning {
    pub(crate) parameters: Parameters,
    pub(crate) sensor_model: SensorModel,
}

impl Tuning {
    /// Validates a set and builds its sensor model. Every fault is listed. The range tables are the map's and built by
    /// [`TrackMap::prepare`]; see [`Tuning::prepare`] for both at once.
    pub fn new(parameters: Parameters, map: &TrackMap) -> Result<Self, Vec<ParameterFault>> {
        parameters.validate()?;
        let sensor_model = SensorModel::new(&parameters, map.grid().resolution);
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
        let tuning = Self::new(parameters, map)?;
        map.prepare(map_from_base_link, &tuning.parameters);
        Ok(PreparedParameters::new(tuning))
    }
}

impl TrackMap {
    /// Builds the range tables that a set needs, if they are not there yet, so that the first update does not have
    /// to: for the region around a pose in `map`, or, without one, for all that look like tracks.
    pub fn prepare(&self, map_from_base_link: Option<Pose>, parameters: &Parameters) {
        match parameters.sensor.range_method {
            RangeMethod::Lut => {
                let at = map_from_base_link.map(|pose| self.region_at(self.grid_from_map() * pose));
                let regions =
                    at.map_or_else(|| self.plausible_regions(), |region| region.into_iter().collect());
                for region in regions {
                    self.table(region, parameters.sensor.table_parameters(parameters.defects));
                }
            }
            RangeMethod::Cddt => {
                self.cddt();
            }
            RangeMethod::RayMarching => {}
        }
    }
}
