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

/// Names and bytes of what a command wrote.
type Written = Vec<(PathBuf, Vec<u8>)>;

pub(super) fn run(_: &Options) -> Result<bool> {
    let program = program()?;
    let folder = tempfile::tempdir()?;
    cases::prepare(folder.path(), &program)?;
    let emulated = Command::new(QEMU).arg("--version").output().is_ok_and(|ran| ran.status.success());
    let mut finds = 0;
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
            finds += 1;
            println!("FOUND: {}: other bytes on {what}", case.name);
        }
    }
    let processors = if emulated {
        format!("{} processors", PROCESSORS.len())
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
