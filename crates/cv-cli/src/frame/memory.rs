//! How much memory the program gives itself.

use std::fs;

/// Where the machine does not say: 4 GiB.
const UNKNOWN: u64 = cv_io::DEFAULT_MAX_MEMORY;

/// Half of the memory of the machine, or of the container the program runs in, in bytes.
pub(super) fn default_limit() -> u64 {
    let read = |path: &str| fs::read_to_string(path).ok();
    let machine = read("/proc/meminfo").and_then(|text| of_meminfo(&text));
    // Version 2 and 1 of the control groups, as a container sees its own.
    let groups = ["/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"];
    let group = groups.into_iter().filter_map(|path| read(path)?.trim().parse().ok());
    machine.into_iter().chain(group).min().map_or(UNKNOWN, |bytes: u64| bytes / 2)
}

/// The memory by `/proc/meminfo`, in bytes.
fn of_meminfo(text: &str) -> Option<u64> {
    let rest = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    rest.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_memory_of_the_machine_is_in_kibibytes() {
        assert_eq!(of_meminfo("MemTotal:       24683520 kB\nMemFree:  1 kB\n"), Some(24_683_520 << 10));
        assert_eq!(of_meminfo("MemFree: 1 kB\n"), None);
        assert!(default_limit() > 0);
    }
}
