//! The instruction sets that tests go through.

use fearless_simd::Level;

/// Every instruction set this machine has, the least first; those it lacks are named once on stderr, as ignored.
pub(crate) fn levels() -> Vec<Level> {
    let best = Level::new();
    let mut all = vec![Level::baseline()];
    #[cfg(target_arch = "x86_64")]
    {
        let known = [
            ("SSE4.2", best.as_sse4_2().map(Level::Sse4_2)),
            ("AVX2", best.as_avx2().map(Level::Avx2)),
            ("AVX-512", best.as_avx512().map(Level::Avx512)),
        ];
        static SAID: std::sync::Once = std::sync::Once::new();
        SAID.call_once(|| {
            for (name, level) in &known {
                if level.is_none() {
                    eprintln!("ignored: this machine has no {name}");
                }
            }
        });
        all.extend(known.into_iter().filter_map(|(_, level)| level));
    }
    all.push(best);
    all
}
