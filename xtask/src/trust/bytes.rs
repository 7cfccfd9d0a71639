//! Determinism: the same bytes on 1, 2 and 5 threads, and on processors with and without AVX2. QEMU emulates the processor, so that this workspace, its
//! dependencies and the C library all select their instructions as on that processor.

use super::{Options, cases, program};
use anyhow::{Result, ensure};
use cases::{CASES, Case};
use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// QEMU's names of the processors: SSE4.2 without AVX; AVX2 with FMA.
const PROCESSORS: [&str; 2] = ["Nehalem", "Haswell"];
const QEMU: &str = "qemu-x86_64";

/// Names and bytes of a command's outputs.
type Outputs = Vec<(PathBuf, Vec<u8>)>;

pub(super) fn run(_: &Options) -> Result<bool> {
    let program = program()?;
    let folder = tempfile::tempdir()?;
    cases::prepare(folder.path(), &program)?;
    let has_qemu = Command::new(QEMU).arg("--version").output().is_ok_and(|output| output.status.success());
    let mut failures = 0;
    for case in CASES {
        let native = |threads: &str| {
            run_case(Command::new(&program).args(case.args()).args(["--threads", threads]), folder.path(), case)
        };
        let reference = native("1")?;
        let mut others = vec![("2 threads", native("2")?), ("5 threads", native("5")?)];
        if has_qemu {
            for processor in PROCESSORS {
                let mut command = Command::new(QEMU);
                command.args(["-cpu", processor]).arg(&program).args(case.args()).args(["--threads", "1"]);
                others.push((processor, run_case(&mut command, folder.path(), case)?));
            }
        }
        for (condition, other) in others {
            if other == reference {
                continue;
            }
            failures += 1;
            println!("FAILURE: {}: different bytes on {condition}", case.name);
        }
    }
    let processors = if has_qemu {
        format!("{} processors", PROCESSORS.len())
    } else {
        format!("NOT RUN on other processors, since {QEMU} is not installed")
    };
    println!("{} commands on 1, 2 and 5 threads; {processors}; {failures} failures", CASES.len());
    Ok(failures == 0)
}

/// Runs a command; returns its output files and its JSON, without the report and the JSON entries that contain times.
fn run_case(command: &mut Command, folder: &Path, case: &Case) -> Result<Outputs> {
    let out = folder.join("out");
    fs::remove_dir_all(&out)?;
    fs::create_dir(&out)?;
    command.current_dir(folder);
    if !case.args.contains("--json") {
        command.arg("--json");
    }
    let output = command.output()?;
    ensure!(output.status.success(), "{}: {}", case.name, String::from_utf8_lossy(&output.stderr));
    let mut json: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    if let Some(json) = json.as_object_mut() {
        json.remove("seconds");
        json.remove("threads");
    }
    let mut files = cases::snapshot(&out)?;
    files.retain(|(path, _)| path.extension().is_none_or(|extension| extension != "html"));
    for (path, _) in &mut files {
        *path = path.strip_prefix(folder)?.to_owned();
    }
    files.push((PathBuf::from("stdout"), serde_json::to_vec_pretty(&json)?));
    Ok(files)
}
