//! The state that the vehicle's dynamics integrate.

/// Position, velocity, wheel speed, tyre slip, pitch and steering.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct VehicleState {
    /// Position of the centre of gravity in `map` \[m\].
    pub x: f64,
    /// Position of the centre of gravity in `map` \[m\].
    pub y: f64,
    /// Heading, not wrapped \[rad\].
    pub heading: f64,
    /// Speed of the centre of gravity, forwards \[m/s\].
    pub vx: f64,
    /// Speed of the centre of gravity, to the left \[m/s\].
    pub vy: f64,
    /// Yaw rate, left positive \[rad/s\].
    pub yaw_rate: f64,
    /// Speed of the wheels' circumference \[m/s\].
    pub wheel_speed: f64,
    /// Slip of the front tyres, longitudinal and lateral, delayed by their relaxation length.
    pub front_slip: [f64; 2],
    /// Slip of the rear tyres, likewise.
    pub rear_slip: [f64; 2],
    /// Longitudinal acceleration, delayed by the springs \[m/s^2\]. It shifts load between the axles.
    pub pitch_acceleration: f64,
    /// Steering angle of the front wheels \[rad\].
    pub steering: f64,
}

const SIZE: usize = 13;

impl VehicleState {
    pub(crate) fn array(&self) -> [f64; SIZE] {
        let (front, rear) = (self.front_slip, self.rear_slip);
        [
            self.x,
            self.y,
            self.heading,
            self.vx,
            self.vy,
            self.yaw_rate,
            self.wheel_speed,
            front[0],
            front[1],
            rear[0],
            rear[1],
            self.pitch_acceleration,
            self.steering,
        ]
    }

    pub(crate) fn from_array(a: [f64; SIZE]) -> Self {
        Self {
            x: a[0],
            y: a[1],
            heading: a[2],
            vx: a[3],
            vy: a[4],
            yaw_rate: a[5],
            wheel_speed: a[6],
            front_slip: [a[7], a[8]],
            rear_slip: [a[9], a[10]],
            pitch_acceleration: a[11],
            steering: a[12],
        }
    }

    /// `self + rate * time`.
    pub(crate) fn advanced(&self, rate: &Self, time: f64) -> Self {
        let (state, rate) = (self.array(), rate.array());
        Self::from_array(std::array::from_fn(|i| state[i] + rate[i] * time))
    }
}
