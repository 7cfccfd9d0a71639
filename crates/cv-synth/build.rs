//! Tells the tests which instruction sets this machine lacks, so that they are ignored by name and not passed over in silence.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    for (name, present) in [("avx2", avx2()), ("avx512", avx512())] {
        println!("cargo::rustc-check-cfg=cfg(without_{name})");
        if !present {
            println!("cargo::rustc-cfg=without_{name}");
        }
    }
}

#[cfg(target_arch = "x86_64")]
fn avx2() -> bool {
    std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
}

/// As much of it as Ice Lake has, which is what the code is compiled for.
#[cfg(target_arch = "x86_64")]
fn avx512() -> bool {
    avx2()
        && std::arch::is_x86_feature_detected!("avx512bw")
        && std::arch::is_x86_feature_detected!("avx512vbmi2")
        && std::arch::is_x86_feature_detected!("avx512vpopcntdq")
}

#[cfg(not(target_arch = "x86_64"))]
fn avx2() -> bool {
    false
}

#[cfg(not(target_arch = "x86_64"))]
fn avx512() -> bool {
    false
}
