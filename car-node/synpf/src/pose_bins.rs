//! Particles counted in bins: how many bins they fill, and whether they form a second cluster.

use crate::pose_array::PoseArray;

/// A hash table of the bins that particles fall into. A new generation empties it.
#[derive(Debug, Clone)]
pub(crate) struct PoseBins {
    /// The bin, the generation and the mass.
    slots: Vec<(u64, u32, f32)>,
    generation: u32,
}

/// Number of slots; a power of two.
const SLOTS: usize = 1 << 13;

impl PoseBins {
    /// An empty table.
    pub(crate) fn new() -> Self {
        Self {
            slots: vec![(0, 0, 0.0); SLOTS],
            generation: 0,
        }
    }

    /// Empties the table.
    fn clear(&mut self) {
        self.generation = self.generation.wrapping_add(1);
        if self.generation == 0 {
            self.slots.fill((0, 0, 0.0));
            self.generation = 1;
        }
    }

    /// Adds mass to a bin; true if the bin is new. A full table ignores new bins.
    fn add(&mut self, key: u64, mass: f32) -> bool {
        let mut slot = (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 51) as usize % SLOTS;
        for _ in 0..64 {
            let entry = &mut self.slots[slot];
            if entry.1 != self.generation {
                *entry = (key, self.generation, mass);
                return true;
            }
            if entry.0 == key {
                entry.2 += mass;
                return false;
            }
            slot = (slot + 1) % SLOTS;
        }
        false
    }

    /// Number of bins of 0.25 m and 10 deg that hold particles of some weight.
    pub(crate) fn filled(&mut self, poses: &PoseArray, weight: &[f32]) -> usize {
        self.clear();
        let least = 1e-3 / poses.len() as f32;
        let (x, y, heading) = (poses.x(), poses.y(), poses.heading());
        let mut filled = 0;
        for i in (0..poses.len()).filter(|&i| weight[i] > least) {
            let key = bin_key(x[i] / 0.25, y[i] / 0.25, heading[i] / 10f32.to_radians());
            filled += usize::from(self.add(key, weight[i]));
        }
        filled
    }

    /// Mass of the second cluster over that of the first, among clusters of 0.5 m and 20 deg.
    pub(crate) fn second_mode(&mut self, poses: &PoseArray, weight: &[f32]) -> f64 {
        self.clear();
        let (x, y, heading) = (poses.x(), poses.y(), poses.heading());
        for i in 0..poses.len() {
            let key = bin_key(x[i] / 0.5, y[i] / 0.5, heading[i] / 20f32.to_radians());
            self.add(key, weight[i]);
        }
        let generation = self.generation;
        let full = |slot: &&(u64, u32, f32)| slot.1 == generation;
        // A cluster is the heaviest bin with its neighbours, because its mass spreads over all of them.
        let heaviest = |without: Option<u64>| {
            let free = |key: u64| without.is_none_or(|taken| !touch(key, taken));
            let bins = || self.slots.iter().filter(full).filter(|slot| free(slot.0));
            let centre = bins().max_by(|a, b| a.2.total_cmp(&b.2))?.0;
            let mass: f32 = bins()
                .filter(|slot| touch(slot.0, centre))
                .map(|slot| slot.2)
                .sum();
            Some((centre, mass))
        };
        let Some((centre, first)) = heaviest(None) else {
            return 0.0;
        };
        let second = heaviest(Some(centre)).map_or(0.0, |(_, mass)| mass);
        f64::from(first.min(second) / first.max(second).max(1e-9))
    }
}

/// Whether two bins are the same or neighbours. Headings wrap after 18 bins of 20 deg.
fn touch(a: u64, b: u64) -> bool {
    let parts = |key: u64| [key >> 40, (key >> 16) & 0xFF_FFFF, key & 0xFFFF].map(|v| v as i64);
    let (a, b) = (parts(a), parts(b));
    let turn = (a[2] - b[2]).rem_euclid(18).min((b[2] - a[2]).rem_euclid(18));
    (a[0] - b[0]).abs() <= 1 && (a[1] - b[1]).abs() <= 1 && turn <= 1
}

/// The key of a bin by its place in bins.
fn bin_key(x: f32, y: f32, heading: f32) -> u64 {
    let place = |v: f32| (v.floor() as i64 + (1 << 22)) as u64 & 0xFF_FFFF;
    (place(x) << 40) | (place(y) << 16) | ((heading.floor() as i64 + (1 << 14)) as u64 & 0xFFFF)
}
