//! Wheels that lock or spin: they gain or lose speed as no tyre can make a car do. Then the car's own speed is carried on.

use std::collections::VecDeque;

use localizer::{SensorFinding, SensorFindings, Stamp};

/// Follows the speed of the wheels and, while they slide, that of the car.
#[derive(Debug, Clone, Default)]
pub(crate) struct WheelGrip {
    /// The wheels' speed over the last [`SPAN`].
    speeds: VecDeque<(Stamp, f64)>,
    sliding: Option<Sliding>,
    wheels: f64,
}

#[derive(Debug, Clone, Copy)]
struct Sliding {
    since: Stamp,
    at: Stamp,
    /// 1 for wheels that began to spin, -1 for wheels that locked.
    onset: f64,
    /// The car's speed before [m/s], and now.
    before: f64,
    car: f64,
    /// Messages on end in which the wheels had the car's speed again.
    gripping: u32,
}

/// Speeds are compared over this \[s\].
const SPAN: f64 = 0.08;

/// No tyre accelerates or brakes a car harder [m/s^2]: a coefficient of friction of 1.2.
const HARDEST: f64 = 12.0;

/// Noise of a wheel's speed [m/s].
const NOISE: f64 = 0.4;

/// What tyres that slide brake with [m/s^2]: half of what they can hold.
const SLIDING_BRAKE: f64 = 5.0;

/// The wheels have the car's speed again within this share of it, and this [m/s]...
const SAME: [f64; 2] = [0.15, 0.3];
/// ...for so many messages on end.
const GRIPPING: u32 = 3;

/// A speed by the scans that differs by more is none: the pose was found elsewhere [m/s].
const PLAUSIBLE: f64 = 3.0;

/// Longer than this no wheel slides: the car was held, or its speed was misjudged \[s\].
const LONGEST: f64 = 2.0;

impl WheelGrip {
    /// Takes in the wheels' speed [m/s]. Returns the car's, which is the same while they grip.
    pub(crate) fn speed(&mut self, stamp: Stamp, wheels: f64) -> f64 {
        self.wheels = wheels;
        while self
            .speeds
            .front()
            .is_some_and(|(then, _)| stamp.since(*then) > SPAN)
        {
            self.speeds.pop_front();
        }
        if self.sliding.is_none() {
            let onset = self
                .speeds
                .iter()
                .rev()
                .find(|(then, before)| (wheels - before).abs() > HARDEST * stamp.since(*then) + NOISE);
            self.sliding = onset.map(|&(since, car)| Sliding {
                since,
                at: since,
                onset: (wheels - car).signum(),
                before: car,
                car,
                gripping: 0,
            });
        }
        // Wheels that jump back have caught the ground, whatever the car's speed was thought to be.
        let caught = self.sliding.is_some_and(|sliding| {
            self.speeds.iter().any(|(then, before)| {
                sliding.onset * (before - wheels) > HARDEST * stamp.since(*then) + NOISE
            })
        });
        if caught {
            self.release();
        }
        self.speeds.push_back((stamp, wheels));
        let Some(sliding) = &mut self.sliding else {
            return wheels;
        };
        // Towards the wheels' speed, as tyres that slide can.
        let change = SLIDING_BRAKE * stamp.since(sliding.at).max(0.0);
        sliding.car += (wheels - sliding.car).clamp(-change, change);
        sliding.at = stamp;
        let car = sliding.car;
        let same = (wheels - car).abs() < SAME[0] * car.abs() + SAME[1];
        sliding.gripping = if same { sliding.gripping + 1 } else { 0 };
        if sliding.gripping >= GRIPPING || stamp.since(sliding.since) > LONGEST {
            self.release();
        }
        car
    }

    /// Whether the wheels slide.
    pub(crate) fn is_sliding(&self) -> bool {
        self.sliding.is_some()
    }

    /// For how long the wheels have slid \[s\]; None while they grip.
    pub(crate) fn sliding_for(&self) -> Option<f64> {
        self.sliding.map(|sliding| sliding.at.since(sliding.since))
    }

    /// Ends a slide: the wheels say nothing of the car any more.
    pub(crate) fn release(&mut self) {
        self.sliding = None;
        self.speeds.clear();
    }

    /// The car's speed while the wheels slide [m/s].
    pub(crate) fn sliding_speed(&self) -> Option<f64> {
        self.sliding.map(|sliding| sliding.car)
    }

    /// The scans say that the car drives at `speed` [m/s]; `share` of it is to be believed, in [0, 1].
    pub(crate) fn correct(&mut self, speed: f64, share: f64) {
        if let Some(sliding) = &mut self.sliding
            && (speed - sliding.car).abs() < PLAUSIBLE
        {
            let car = sliding.car + share.clamp(0.0, 1.0) * (speed - sliding.car);
            // Tyres that slide bring the car nearer to the speed of its wheels.
            let (low, high) = (sliding.before.min(self.wheels), sliding.before.max(self.wheels));
            sliding.car = car.clamp(low, high);
        }
    }

    pub(crate) fn report(&self, findings: &mut SensorFindings) {
        if let Some(sliding) = self.sliding {
            findings.insert(SensorFinding::WheelsSlide, self.wheels - sliding.car);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Distance that the car is said to go in 2 s at 50 Hz with wheels of this speed \[m\].
    fn driven(wheels: impl Fn(f64) -> f64) -> f64 {
        let mut grip = WheelGrip::default();
        (0..100)
            .map(|i| {
                let t = f64::from(i) * 0.02;
                grip.speed(Stamp(0).plus(t), wheels(t)) * 0.02
            })
            .sum()
    }

    #[test]
    fn a_car_whose_wheels_lock_slides_on() {
        // From 5 m/s the tyres take 1 s to stop the car: 2.5 m. The wheels stop at once.
        let distance = driven(|t| if t < 0.5 { 5.0 } else { 0.0 });
        assert!((distance - 5.0).abs() < 0.3, "{distance}");
    }

    #[test]
    fn wheels_that_spin_do_not_carry_the_car_on() {
        let distance = driven(|t| if (0.5..0.8).contains(&t) { 6.0 } else { 3.0 });
        // At 6 m/s it would be 6.9 m.
        assert!((6.0..6.6).contains(&distance), "{distance}");
    }

    #[test]
    fn wheels_that_catch_the_ground_again_are_believed_at_once() {
        // The car rolls on at 5 m/s: it was a fault of the reading, or ice.
        let mut grip = WheelGrip::default();
        for i in 0..100 {
            let t = f64::from(i) * 0.02;
            let wheels = if (0.5..1.0).contains(&t) { 0.0 } else { 5.0 };
            let car = grip.speed(Stamp(0).plus(t), wheels);
            assert!(t < 1.0 || car > 4.99, "{car} m/s at {t} s");
        }
        assert!(!grip.is_sliding());
    }

    #[test]
    fn hard_braking_is_no_slide() {
        let braking = |t: f64| (6.0 - 9.0 * t).max(0.0) + 0.1 * (300.0 * t).sin();
        let mut grip = WheelGrip::default();
        for i in 0..100 {
            let t = f64::from(i) * 0.02;
            grip.speed(Stamp(0).plus(t), braking(t));
            assert!(!grip.is_sliding(), "{t}");
        }
    }
}
