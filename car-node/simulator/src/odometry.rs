//! Wheel odometry and gyroscope, with the errors of real ones.

use std::time::Duration;

use maps::Pose;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

/// The source of odometry's yaw rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum YawSource {
    /// The gyroscope, as a filter that fuses it with the motor's speed gives it.
    Gyro,
    /// Speed times the tangent of the commanded steering angle over the wheelbase, as `vesc_to_odom` does it.
    Steering,
}

/// Odometry of a VESC motor controller and the gyroscope beside it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OdometryParams {
    /// From one odometry message to the next.
    pub period: Duration,
    /// From its stamp to its arrival.
    pub transport: Duration,
    /// The source of the yaw rate.
    pub yaw_source: YawSource,
    /// Relative error of the speed calibration: tyres wear, and grow with speed.
    pub speed_scale: f64,
    /// Standard deviation of a speed reading \[m/s\].
    pub speed_noise: f64,
    /// From one gyroscope message to the next.
    pub gyro_period: Duration,
    /// Bias of the gyroscope at the start: standard deviation \[rad/s\].
    pub gyro_bias: f64,
    /// Random walk of the bias \[rad/s per square root of a second\].
    pub gyro_walk: f64,
    /// Standard deviation of a yaw-rate reading \[rad/s\].
    pub gyro_noise: f64,
    /// Relative error of the gyroscope's scale.
    pub gyro_scale: f64,
}

impl Default for OdometryParams {
    /// A VESC 6 with its own MEMS gyroscope (0.005 deg/s per root Hz; bias left over after a calibration at rest).
    fn default() -> Self {
        Self {
            period: Duration::from_millis(20),
            transport: Duration::from_millis(1),
            yaw_source: YawSource::Gyro,
            speed_scale: 0.01,
            speed_noise: 0.01,
            gyro_period: Duration::from_millis(10),
            gyro_bias: 0.003,
            gyro_walk: 0.0003,
            gyro_noise: 0.01,
            gyro_scale: 0.005,
        }
    }
}

/// One message of wheel odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Odometry {
    /// Time of the measurement, since the start of the race.
    pub stamp: Duration,
    /// `odom_from_base_link`.
    pub pose: Pose,
    /// Speed of the wheels \[m/s\].
    pub speed: f64,
    /// Yaw rate \[rad/s\].
    pub yaw_rate: f64,
}

/// One reading of the gyroscope.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gyro {
    /// Time of the measurement, since the start of the race.
    pub stamp: Duration,
    /// Yaw rate, left positive \[rad/s\].
    pub yaw_rate: f64,
}

/// The true motion that both sensors measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Speed of the wheels' circumference \[m/s\].
    pub wheel_speed: f64,
    /// True yaw rate \[rad/s\].
    pub yaw_rate: f64,
    /// Commanded steering angle \[rad\].
    pub steering: f64,
}

/// Running odometry and gyroscope.
#[derive(Debug)]
pub struct OdometrySensor {
    params: OdometryParams,
    wheelbase: f64,
    rng: StdRng,
    pose: Pose,
    bias: f64,
    latest_gyro: f64,
    next: Duration,
    next_gyro: Duration,
}

impl OdometrySensor {
    /// The gyroscope's latest reading \[rad/s\].
    pub fn gyro_yaw_rate(&self) -> f64 {
        self.latest_gyro
    }

    /// Odometry that starts at the origin of `odom`.
    pub fn new(params: OdometryParams, wheelbase: f64, start: Duration, mut rng: StdRng) -> Self {
        let draw: f64 = StandardNormal.sample(&mut rng);
        Self {
            params,
            wheelbase,
            rng,
            pose: Pose::IDENTITY,
            bias: params.gyro_bias * draw,
            latest_gyro: 0.0,
            next: start,
            next_gyro: start,
        }
    }

    /// The parameters.
    pub fn params(&self) -> &OdometryParams {
        &self.params
    }

    /// A gyroscope reading, if one is due at `now`.
    pub fn gyro(&mut self, now: Duration, motion: Motion) -> Option<Gyro> {
        if now < self.next_gyro {
            return None;
        }
        self.next_gyro += self.params.gyro_period;
        let walk: f64 = StandardNormal.sample(&mut self.rng);
        let noise: f64 = StandardNormal.sample(&mut self.rng);
        self.bias += self.params.gyro_walk * self.params.gyro_period.as_secs_f64().sqrt() * walk;
        self.latest_gyro =
            motion.yaw_rate * (1.0 + self.params.gyro_scale) + self.bias + self.params.gyro_noise * noise;
        Some(Gyro {
            stamp: now,
            yaw_rate: self.latest_gyro,
        })
    }

    /// An odometry message, if one is due at `now`: the latest readings, held for the whole period and integrated as
    /// `vesc_to_odom` does (position first, along the old heading).
    pub fn odometry(&mut self, now: Duration, motion: Motion) -> Option<Odometry> {
        if now < self.next {
            return None;
        }
        self.next += self.params.period;
        let noise: f64 = StandardNormal.sample(&mut self.rng);
        let speed = if motion.wheel_speed.abs() < 1e-3 {
            // A motor at rest reports exactly zero.
            0.0
        } else {
            motion.wheel_speed * (1.0 + self.params.speed_scale) + self.params.speed_noise * noise
        };
        let yaw_rate = match self.params.yaw_source {
            YawSource::Gyro => self.latest_gyro,
            YawSource::Steering => speed * motion.steering.tan() / self.wheelbase,
        };
        let dt = self.params.period.as_secs_f64();
        let (sin, cos) = self.pose.heading.sin_cos();
        self.pose = Pose::new(
            self.pose.x + speed * cos * dt,
            self.pose.y + speed * sin * dt,
            self.pose.heading + yaw_rate * dt,
        );
        Some(Odometry {
            stamp: now,
            pose: self.pose,
            speed,
            yaw_rate,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn perfect(yaw_source: YawSource) -> OdometryParams {
        OdometryParams {
            yaw_source,
            speed_scale: 0.0,
            speed_noise: 0.0,
            gyro_bias: 0.0,
            gyro_walk: 0.0,
            gyro_noise: 0.0,
            gyro_scale: 0.0,
            ..OdometryParams::default()
        }
    }

    fn drive(params: OdometryParams, motion: Motion, seconds: u64) -> Odometry {
        let mut sensor = OdometrySensor::new(params, 0.31, Duration::ZERO, StdRng::seed_from_u64(3));
        let mut last = None;
        let mut now = Duration::ZERO;
        while now < Duration::from_secs(seconds) {
            sensor.gyro(now, motion);
            last = sensor.odometry(now, motion).or(last);
            now += Duration::from_micros(2500);
        }
        last.expect("odometry every 20 ms")
    }

    #[test]
    fn perfect_odometry_follows_a_circle_from_either_source() {
        // One round of radius 2 m in 5 s: back at the start, up to half a step of held readings.
        let yaw_rate = std::f64::consts::TAU / 5.0;
        let motion = Motion {
            wheel_speed: 2.0 * yaw_rate,
            yaw_rate,
            steering: (0.31_f64 / 2.0).atan(),
        };
        for source in [YawSource::Gyro, YawSource::Steering] {
            let end = drive(perfect(source), motion, 5).pose;
            assert!(end.distance(Pose::IDENTITY) < 0.03, "{source:?}: {end:?}");
        }
    }

    #[test]
    fn odometry_measures_the_wheels_and_not_the_car() {
        let motion = Motion {
            wheel_speed: 3.0,
            yaw_rate: 0.0,
            steering: 0.0,
        };
        let end = drive(perfect(YawSource::Gyro), motion, 2).pose;
        assert!((end.x - 6.0).abs() < 0.01);
    }

    #[test]
    fn a_car_at_rest_turns_with_the_gyro_s_bias_only() {
        let params = OdometryParams {
            gyro_noise: 0.0,
            gyro_walk: 0.0,
            ..OdometryParams::default()
        };
        let motion = Motion {
            wheel_speed: 0.0,
            yaw_rate: 0.0,
            steering: 0.1,
        };
        let end = drive(params, motion, 10);
        assert!((end.pose.x).abs() < 1e-12);
        // Three standard deviations of the bias over 10 s.
        assert!(end.pose.heading.abs() < 3.0 * params.gyro_bias * 10.0);
        assert!((end.pose.heading - 10.0 * end.yaw_rate).abs() < 1e-9);
    }
}
