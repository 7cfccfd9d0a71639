//! Behavior common to all commands, as a black box: usage, help, exit codes, stdout and stderr.

use crate::support::{cv, done, json, refused, run};

/// Returns the names in the list of commands.
fn commands() -> Vec<String> {
    let help = done(&std::env::temp_dir(), &["--help"]).stdout;
    let list = help.split("Commands:\n").nth(1).unwrap().split("\n\n").next().unwrap();
    let names = list.lines().filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names.map(|line| line.split_whitespace().next().unwrap().to_owned()).filter(|name| name != "help").collect()
}

/// Returns the names of a command and its subcommands.
fn commands_within(folder: &std::path::Path, name: &str) -> Vec<Vec<String>> {
    let help = done(folder, &[name, "--help"]).stdout;
    match help.split("Commands:\n").nth(1) {
        None => vec![vec![name.to_owned()]],
        Some(list) => list
            .lines()
            .take_while(|line| !line.is_empty())
            .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
            .map(|line| line.split_whitespace().next().unwrap().to_owned())
            .filter(|inner| inner != "help")
            .map(|inner| vec![name.to_owned(), inner])
            .collect(),
    }
}

#[test]
fn the_help_of_every_command_has_examples() {
    let folder = tempfile::tempdir().unwrap();
    for name in commands() {
        for path in commands_within(folder.path(), &name) {
            let mut args: Vec<&str> = path.iter().map(String::as_str).collect();
            args.push("--help");
            let help = done(folder.path(), &args).stdout;
            let example = format!("cv {}", path.join(" "));
            assert!(help.contains("Examples:"), "{path:?}: {help}");
            let examples = help.split("Examples:").nth(1).unwrap();
            assert!(examples.contains(&example), "{path:?}: {examples}");
        }
    }
}

#[test]
fn wrong_usage_is_exit_code_2_without_output_on_stdout() {
    let folder = tempfile::tempdir().unwrap();
    let cases: [&[&str]; 7] = [
        &[],
        &["no-such-command"],
        &["--no-such-option"],
        &["completions", "no-such-shell"],
        &["completions", "bash", "--threads", "0"],
        &["completions", "bash", "--threads", "two"],
        &["completions", "bash", "--seed", "-1"],
    ];
    for args in cases {
        let ran = run(folder.path(), args);
        assert_eq!((ran.code, ran.stdout.as_str()), (Some(2), ""), "cv {args:?}: {ran:?}");
        assert!(!ran.stderr.is_empty());
    }
    for name in commands() {
        for path in commands_within(folder.path(), &name) {
            let mut args: Vec<&str> = path.iter().map(String::as_str).collect();
            args.push("--no-such-option");
            let ran = run(folder.path(), &args);
            assert_eq!((ran.code, ran.stdout.as_str()), (Some(2), ""), "cv {args:?}: {ran:?}");
        }
    }
}

#[test]
fn the_option_threads_sets_the_thread_count() {
    let folder = tempfile::tempdir().unwrap();
    for threads in [1, 3] {
        let value = json(folder.path(), &["completions", "zsh", "--threads", &threads.to_string()]);
        assert_eq!(value["threads"], threads);
    }
}

#[test]
fn a_closed_stdout_is_a_failure_and_not_a_crash() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = cv(folder.path())
        .args(["completions", "bash"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    // The script may have fitted into the pipe's buffer before the pipe was closed; then the run succeeded.
    assert!(matches!(output.status.code(), Some(0 | 1)), "{output:?}");
    assert!(!String::from_utf8_lossy(&output.stderr).contains("panicked"), "{output:?}");
}

/// A global option either has an effect on a command or is refused, such as `--seed` and `--report` by some.
#[test]
fn options_without_effect_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let matches: String = (0..40)
        .map(|i| (f64::from(i * 37 % 97), f64::from(i * 53 % 89)))
        .map(|(x, y)| format!("{x} {y} {} {y}\n", x + 7.0))
        .collect();
    std::fs::write(folder.path().join("m.txt"), matches).unwrap();
    let cases: [(&[&str], bool, bool); 4] = [
        (&["completions", "bash"], false, false),
        (&["man", "--out", "pages"], false, false),
        (&["estimate", "homography", "--matches", "m.txt"], true, true),
        (&["eval", "disparity", "--estimate", "d.pfm", "--truth", "t.pfm"], false, true),
    ];
    for name in ["d.pfm", "t.pfm"] {
        cv_io::pfm::write(folder.path().join(name), cv_core::GrayF32::new(9, 9, [2.0]).view()).unwrap();
    }
    for (args, seed, report) in cases {
        for (option, taken) in [(["--seed", "3"], seed), (["--report", "page"], report)] {
            let ran = run(folder.path(), &[args, &option].concat());
            assert_eq!(ran.code, Some(if taken { 0 } else { 2 }), "cv {args:?} {option:?}: {ran:?}");
            assert_eq!(ran.stderr.contains("has no effect here"), !taken, "cv {args:?} {option:?}: {ran:?}");
        }
        let page = folder.path().join("page/report.html");
        assert_eq!(page.exists(), report, "cv {args:?}");
        let _ = std::fs::remove_file(page);
    }
}

#[test]
fn a_file_above_the_memory_limit_is_refused_with_a_sufficient_limit() {
    let folder = tempfile::tempdir().unwrap();
    // 2 MB as a file, and as much again decoded.
    let mut map = b"Pf\n800 700\n-1\n".to_vec();
    map.resize(map.len() + 4 * 800 * 700, 0x3f);
    std::fs::write(folder.path().join("a.pfm"), map).unwrap();
    let args = ["eval", "disparity", "--estimate", "a.pfm", "--truth", "a.pfm", "--max-memory"];
    for too_little in ["1", "3"] {
        let ran = refused(folder.path(), &[&args[..], &[too_little]].concat());
        assert!(ran.stderr.contains("MiB") && ran.stderr.contains("try: --max-memory"), "{ran:?}");
        if too_little == "3" {
            assert!(ran.stderr.contains("800×700") && ran.stderr.contains("--max-memory 5, or a smaller"), "{ran:?}");
        }
    }
    done(folder.path(), &[&args[..], &["5"]].concat());
}
