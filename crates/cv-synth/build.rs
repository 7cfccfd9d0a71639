//! Sets a cfg for each instruction set that this machine lacks, so that its tests are reported as ignored.

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

/// The subset of Ice Lake, which the code is compiled for.
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
