//! The default memory limit.

use std::fs;

/// Limit in bytes if the machine's memory is unknown: 4 GiB.
const FALLBACK_LIMIT: u64 = cv_io::DEFAULT_MAX_MEMORY;

/// Returns half of the memory of the machine or of the container, in bytes.
pub(super) fn default_limit() -> u64 {
    let read = |path: &str| fs::read_to_string(path).ok();
    let machine = read("/proc/meminfo").and_then(|text| total_memory(&text));
    // Control groups v2 and v1, as seen in a container.
    let groups = ["/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"];
    let group = groups.into_iter().filter_map(|path| read(path)?.trim().parse().ok());
    machine.into_iter().chain(group).min().map_or(FALLBACK_LIMIT, |bytes: u64| bytes / 2)
}

/// Parses the total memory in `/proc/meminfo`, in bytes.
fn total_memory(text: &str) -> Option<u64> {
    let rest = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    rest.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_memory_of_the_machine_is_in_kibibytes() {
        assert_eq!(total_memory("MemTotal:       24683520 kB\nMemFree:  1 kB\n"), Some(24_683_520 << 10));
        assert_eq!(total_memory("MemFree: 1 kB\n"), None);
        assert!(default_limit() > 0);
    }
}
