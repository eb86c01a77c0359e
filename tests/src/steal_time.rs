//! Steal time: processor time that the host of a virtual machine gives to others.

use std::fs;

/// Steal time since the machine started, summed over all processors, in hundredths of a second. None where it is not known,
/// as outside Linux.
pub fn steal_time() -> Option<u64> {
    parse(&fs::read_to_string("/proc/stat").ok()?)
}

/// The eighth number of the line for all processors (proc(5): user, nice, system, idle, iowait, irq, softirq, steal).
fn parse(stat: &str) -> Option<u64> {
    let numbers = stat.lines().next()?.strip_prefix("cpu ")?;
    numbers.split_whitespace().nth(7)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::parse;

    #[test]
    fn the_steal_time_of_all_processors_is_read() {
        let stat = "cpu  10 20 30 40 50 60 70 80 90 0\ncpu0 1 2 3 4 5 6 7 8 9 0\n";
        assert_eq!(parse(stat), Some(80));
        for other in [
            "",
            "cpu0 1 2 3 4 5 6 7 8 9 0\n",
            "cpu  1 2 3 4\n",
            "cpu  1 2 3 4 5 6 7 x\n",
        ] {
            assert_eq!(parse(other), None, "{other:?}");
        }
    }
}
