//! A set of sequence numbers.

use std::collections::BTreeMap;

/// A set of sequence numbers, stored as ranges. Each number carries a label.
///
/// Ranges are ascending and do not overlap. Two ranges with the same label never touch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NumberRanges<L = ()> {
    /// The last number and the label of each range, by its first number.
    ranges: BTreeMap<u64, (u64, L)>,
}

impl<L> Default for NumberRanges<L> {
    fn default() -> Self {
        Self {
            ranges: BTreeMap::new(),
        }
    }
}

impl<L: Copy + PartialEq> NumberRanges<L> {
    /// Adds the numbers `from` to `to`, both included. Numbers already in the set get the new label.
    pub(crate) fn insert(&mut self, [mut from, mut to]: [u64; 2], label: L) {
        if to < from {
            return;
        }
        self.remove_range([from, to]);
        if let Some((&start, &(end, before))) = self.ranges.range(..from).next_back()
            && end + 1 == from
            && before == label
        {
            from = start;
        }
        if let Some(next) = to.checked_add(1)
            && let Some(&(end, after)) = self.ranges.get(&next)
            && after == label
        {
            self.ranges.remove(&next);
            to = end;
        }
        self.ranges.insert(from, (to, label));
    }

    /// Removes a number; false when it was not in the set.
    pub(crate) fn remove(&mut self, number: u64) -> bool {
        self.remove_range([number, number])
    }

    /// Removes every number below `limit`.
    pub(crate) fn remove_below(&mut self, limit: u64) {
        if let Some(to) = limit.checked_sub(1) {
            self.remove_range([0, to]);
        }
    }

    /// Removes the numbers `from` to `to`; false when none of them was in the set.
    fn remove_range(&mut self, [from, to]: [u64; 2]) -> bool {
        let mut removed = false;
        if let Some((&start, &(end, label))) = self.ranges.range(..from).next_back()
            && end >= from
        {
            removed = true;
            self.ranges.insert(start, (from - 1, label));
            if end > to {
                self.ranges.insert(to + 1, (end, label));
            }
        }
        while let Some((&start, &(end, label))) = self.ranges.range(from..=to).next() {
            removed = true;
            self.ranges.remove(&start);
            if end > to {
                self.ranges.insert(to + 1, (end, label));
            }
        }
        removed
    }

    /// Removes the lowest range and returns it.
    pub(crate) fn pop_first(&mut self) -> Option<[u64; 2]> {
        let (from, (to, _)) = self.ranges.pop_first()?;
        Some([from, to])
    }

    /// True when there is no number in the set.
    pub(crate) fn is_empty(&self) -> bool {
        self.ranges.is_empty()
    }

    /// The lowest number and its label.
    pub(crate) fn first(&self) -> Option<(u64, L)> {
        self.ranges
            .iter()
            .next()
            .map(|(&from, &(_, label))| (from, label))
    }

    /// The ranges, as the first and the last number, ascending.
    pub(crate) fn iter(&self) -> impl Iterator<Item = [u64; 2]> {
        self.ranges.iter().map(|(&from, &(to, _))| [from, to])
    }

    /// The number of ranges.
    pub(crate) fn range_count(&self) -> usize {
        self.ranges.len()
    }

    /// The number of numbers up to `last`.
    pub(crate) fn count_up_to(&self, last: u64) -> u64 {
        let ranges = self.iter().take_while(|[from, _]| *from <= last);
        ranges.fold(0, |count: u64, [from, to]| {
            count.saturating_add(to.min(last) - from).saturating_add(1)
        })
    }

    /// The number of numbers in the set.
    pub(crate) fn count(&self) -> u64 {
        self.count_up_to(u64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Debug, Clone)]
    enum Step {
        Insert(u64, u64, u8),
        Remove(u64),
        RemoveBelow(u64),
        PopFirst,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            4 => (0..40_u64, 0..6_u64, 0..2_u8).prop_map(|(from, len, label)| Step::Insert(from, from + len, label)),
            4 => (0..48_u64).prop_map(Step::Remove),
            1 => (0..48_u64).prop_map(Step::RemoveBelow),
            1 => Just(Step::PopFirst),
        ]
    }

    /// The ranges of a map from each number to its label.
    fn ranges(numbers: &BTreeMap<u64, u8>) -> Vec<[u64; 2]> {
        let mut ranges: Vec<([u64; 2], u8)> = Vec::new();
        for (&number, &label) in numbers {
            match ranges.last_mut() {
                Some(([_, to], last)) if *to + 1 == number && *last == label => *to = number,
                _ => ranges.push(([number, number], label)),
            }
        }
        ranges.into_iter().map(|(range, _)| range).collect()
    }

    proptest! {
        #[test]
        fn it_behaves_as_a_map_from_each_number_to_its_label(steps in prop::collection::vec(step(), 0..80)) {
            let mut set = NumberRanges::<u8>::default();
            let mut numbers = BTreeMap::<u64, u8>::new();
            for step in steps {
                match step {
                    Step::Insert(from, to, label) => {
                        set.insert([from, to], label);
                        numbers.extend((from..=to).map(|number| (number, label)));
                    }
                    Step::Remove(number) => {
                        prop_assert_eq!(set.remove(number), numbers.remove(&number).is_some());
                    }
                    Step::RemoveBelow(limit) => {
                        set.remove_below(limit);
                        numbers.retain(|number, _| *number >= limit);
                    }
                    Step::PopFirst => {
                        let first = ranges(&numbers).first().copied();
                        prop_assert_eq!(set.pop_first(), first);
                        if let Some([from, to]) = first {
                            numbers.retain(|number, _| !(from..=to).contains(number));
                        }
                    }
                }
                prop_assert_eq!(set.iter().collect::<Vec<_>>(), ranges(&numbers));
                prop_assert_eq!(set.range_count(), ranges(&numbers).len());
                prop_assert_eq!(set.count(), numbers.len() as u64);
                prop_assert_eq!(set.count_up_to(20), numbers.range(..=20).count() as u64);
                prop_assert_eq!(set.first(), numbers.first_key_value().map(|(number, label)| (*number, *label)));
                prop_assert_eq!(set.is_empty(), numbers.is_empty());
            }
        }
    }

    #[test]
    fn the_ends_of_the_number_line_do_not_overflow() {
        let mut set = NumberRanges::default();
        set.insert([0, u64::MAX], ());
        assert_eq!(set.count(), u64::MAX, "saturated");
        assert!(set.remove(u64::MAX) && set.remove(0));
        set.insert([u64::MAX, u64::MAX], ());
        assert_eq!(set.iter().collect::<Vec<_>>(), [[1, u64::MAX]]);
        set.remove_below(0);
        set.remove_below(u64::MAX);
        assert_eq!(set.pop_first(), Some([u64::MAX, u64::MAX]));
    }
}
