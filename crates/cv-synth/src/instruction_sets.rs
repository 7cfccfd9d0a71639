//! The instruction sets that tests run with.

use fearless_simd::Level;

/// Returns every instruction set of this machine, the smallest first. Tests compare each with the same reference; those
/// that the machine lacks are reported as ignored tests of this module.
pub fn instruction_sets() -> Vec<Level> {
    #[cfg_attr(not(target_arch = "x86_64"), allow(unused_mut, reason = "only one elsewhere"))]
    let mut all = vec![Level::baseline()];
    #[cfg(target_arch = "x86_64")]
    {
        let best = Level::new();
        // SSE4.2 is not compiled: see .cargo/config.toml.
        all.extend([best.as_avx2().map(Level::Avx2), best.as_avx512().map(Level::Avx512)].into_iter().flatten());
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn has(name: &str) -> bool {
        instruction_sets().iter().any(|level| format!("{level:?}").starts_with(name))
    }

    #[test]
    #[cfg_attr(
        without_avx2,
        ignore = "this machine has no AVX2: whatever goes through the instruction sets left it out"
    )]
    fn avx2_is_tested() {
        assert!(has("Avx2"));
    }

    #[test]
    #[cfg_attr(
        without_avx512,
        ignore = "this machine has no AVX-512: whatever goes through the instruction sets left it out"
    )]
    fn avx512_is_tested() {
        assert!(has("Avx512"));
    }

    #[test]
    #[cfg_attr(
        not(target_arch = "aarch64"),
        ignore = "this machine has no NEON: whatever goes through the instruction sets left it out"
    )]
    fn neon_is_tested() {
        assert!(has("Neon"));
    }

    #[test]
    fn the_default_instruction_set_is_tested() {
        assert!(has(format!("{:?}", Level::new()).split('(').next().unwrap_or_default()));
    }
}
