//! The same bytes on 1, 2 and 5 threads, and on processors without AVX2 and with it, which QEMU emulates whole: the vector code of this workspace,
//! that of its dependencies and that of the C library all see the processor they would see there.

use super::{Options, cases, program};
use anyhow::{Result, ensure};
use cases::{CASES, Case};
use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// By QEMU's names: SSE4.2 without AVX; AVX2 with FMA.
const PROCESSORS: [&str; 2] = ["Nehalem", "Haswell"];
const QEMU: &str = "qemu-x86_64";

/// Linear algebra of larger systems (faer) fuses multiplications and additions where the processor does: figures in text may differ by rounding there.
const ROUNDING: f64 = 1e-6;

/// Names and bytes of what a command wrote.
type Written = Vec<(PathBuf, Vec<u8>)>;

pub(super) fn run(_: &Options) -> Result<bool> {
    let program = program()?;
    let folder = tempfile::tempdir()?;
    cases::prepare(folder.path(), &program)?;
    let emulated = Command::new(QEMU).arg("--version").output().is_ok_and(|ran| ran.status.success());
    let (mut finds, mut rounded) = (0, 0);
    for case in CASES {
        let plain = |threads: &str| {
            written(Command::new(&program).args(case.args()).args(["--threads", threads]), folder.path(), case)
        };
        let one = plain("1")?;
        let mut others = vec![("2 threads", plain("2")?), ("5 threads", plain("5")?)];
        if emulated {
            for processor in PROCESSORS {
                let mut command = Command::new(QEMU);
                command.args(["-cpu", processor]).arg(&program).args(case.args()).args(["--threads", "1"]);
                others.push((processor, written(&mut command, folder.path(), case)?));
            }
        }
        for (what, other) in others {
            if other == one {
                continue;
            }
            let largest = one.len() == other.len() && one.iter().zip(&other).all(|(a, b)| differ_by_rounding(a, b));
            if largest && PROCESSORS.contains(&what) {
                rounded += 1;
                let names: Vec<_> =
                    one.iter().zip(&other).filter(|(a, b)| a != b).map(|(a, _)| a.0.display().to_string()).collect();
                println!("{}: figures differ by rounding on {what}: {}", case.name, names.join(", "));
            } else {
                finds += 1;
                println!("FOUND: {}: other bytes on {what}", case.name);
            }
        }
    }
    let processors = if emulated {
        format!("{} processors ({rounded} times figures in text that differ by rounding)", PROCESSORS.len())
    } else {
        format!("NOT RUN on other processors, since {QEMU} is not installed")
    };
    println!("{} commands on 1, 2 and 5 threads; {processors}; {finds} finds", CASES.len());
    Ok(finds == 0)
}

/// What a command writes, and prints as JSON: all but the report, which has the times in it.
fn written(command: &mut Command, folder: &Path, case: &Case) -> Result<Written> {
    let out = folder.join("out");
    fs::remove_dir_all(&out)?;
    fs::create_dir(&out)?;
    command.current_dir(folder);
    if !case.args.contains("--json") {
        command.arg("--json");
    }
    let ran = command.output()?;
    ensure!(ran.status.success(), "{}: {}", case.name, String::from_utf8_lossy(&ran.stderr));
    let mut json: serde_json::Value = serde_json::from_slice(&ran.stdout)?;
    if let Some(json) = json.as_object_mut() {
        json.remove("seconds");
        json.remove("threads");
    }
    let mut files = cases::snapshot(&out)?;
    files.retain(|(path, _)| path.extension().is_none_or(|ending| ending != "html"));
    for (path, _) in &mut files {
        *path = path.strip_prefix(folder)?.to_owned();
    }
    files.push((PathBuf::from("stdout"), serde_json::to_vec_pretty(&json)?));
    Ok(files)
}

/// Whether two texts are alike but for the last digits of their numbers.
fn differ_by_rounding(a: &(PathBuf, Vec<u8>), b: &(PathBuf, Vec<u8>)) -> bool {
    if a == b {
        return true;
    }
    let (Ok(left), Ok(right)) = (std::str::from_utf8(&a.1), std::str::from_utf8(&b.1)) else { return false };
    let words = |text: &str| -> Vec<String> { text.split([' ', '\n', ',', ':']).map(str::to_owned).collect() };
    let (left, right) = (words(left), words(right));
    let near = |(a, b): (&String, &String)| {
        let numbers = (a.parse::<f64>(), b.parse::<f64>());
        a == b || matches!(numbers, (Ok(a), Ok(b)) if (a - b).abs() <= ROUNDING * a.abs().max(b.abs()).max(1e-3))
    };
    a.0 == b.0 && left.len() == right.len() && left.iter().zip(&right).all(near)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_told_from_other_figures() {
        let differ = |a: &str, b: &str| differ_by_rounding(&(PathBuf::new(), a.into()), &(PathBuf::new(), b.into()));
        assert!(differ("x: 1.0000000001, y", "x: 1.0, y"));
        assert!(!differ("x: 1.001, y", "x: 1.0, y"));
        assert!(!differ("x: 1.0, y", "x: 1.0, z") && !differ("1 2", "1"));
    }
}
