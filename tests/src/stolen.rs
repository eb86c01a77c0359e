//! Processor time that a virtual machine's host takes away.

use std::fs;

/// How long the host has let processors of this machine wait since it started, in hundredths of a second over all of
/// them; None where nobody tells, as outside Linux. What is less than a hundredth shows later.
pub fn stolen() -> Option<u64> {
    of(&fs::read_to_string("/proc/stat").ok()?)
}

/// The eighth number of the line for all processors (proc(5): user, nice, system, idle, iowait, irq, softirq, steal).
fn of(stat: &str) -> Option<u64> {
    let numbers = stat.lines().next()?.strip_prefix("cpu ")?;
    numbers.split_whitespace().nth(7)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::of;

    #[test]
    fn the_steal_time_of_all_processors_is_read() {
        let stat = "cpu  10 20 30 40 50 60 70 80 90 0\ncpu0 1 2 3 4 5 6 7 8 9 0\n";
        assert_eq!(of(stat), Some(80));
        for other in [
            "",
            "cpu0 1 2 3 4 5 6 7 8 9 0\n",
            "cpu  1 2 3 4\n",
            "cpu  1 2 3 4 5 6 7 x\n",
        ] {
            assert_eq!(of(other), None, "{other:?}");
        }
    }
}
