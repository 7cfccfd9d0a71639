//! Memory limits: the default, and sizes as text.

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

/// MiB in each unit.
const UNITS: [(&str, f64); 7] = [
    ("gib", 1024.0),
    ("mib", 1.0),
    ("gb", 1e9 / 1_048_576.0),
    ("mb", 1e6 / 1_048_576.0),
    ("g", 1024.0),
    ("m", 1.0),
    ("", 1.0),
];

/// Parses a size as MiB, rounded down: a number of MiB, or one with a unit of [`UNITS`] in any case.
pub(super) fn mebibytes(text: &str) -> Result<u32, String> {
    let lower = text.trim().to_ascii_lowercase();
    let number = UNITS.iter().find_map(|(unit, scale)| Some((lower.strip_suffix(unit)?.trim_end(), scale)));
    let size = number.and_then(|(number, scale)| Some(number.parse::<f64>().ok()? * scale));
    let size = size.filter(|size| (1.0..=f64::from(u32::MAX)).contains(size));
    size.map(|size| size as u32)
        .ok_or_else(|| "not a size of at least 1 MiB, such as 2048 (MiB), 512M or 2G".to_owned())
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
    fn a_size_is_in_mebibytes_or_has_a_unit() {
        let sizes = [
            ("2048", 2048),
            ("1.9", 1),
            ("512M", 512),
            ("512 MiB", 512),
            ("2G", 2048),
            ("2gib", 2048),
            ("1.5g", 1536),
            // 2 · 10⁹ and 300 · 10⁶ bytes, rounded down.
            ("2GB", 1907),
            ("300mb", 286),
            ("4294967295", u32::MAX),
        ];
        for (text, expected) in sizes {
            assert_eq!(mebibytes(text), Ok(expected), "{text}");
        }
        for text in ["", "G", "0", "0.5", "-1", "2K", "2 G B", "nan", "inf", "1e30", "two"] {
            assert!(mebibytes(text).unwrap_err().contains("2G"), "{text}");
        }
    }

    #[test]
    fn the_memory_of_the_machine_is_in_kibibytes() {
        assert_eq!(total_memory("MemTotal:       24683520 kB\nMemFree:  1 kB\n"), Some(24_683_520 << 10));
        assert_eq!(total_memory("MemFree: 1 kB\n"), None);
        assert!(default_limit() > 0);
    }
}
