//! Options from a file: `cv.toml` in the current folder, or the file of `--config`.
//!
//! A table is a command, a key the long name of an option; keys outside of tables are global options. They are appended to the arguments of the command
//! line, except those that it gives or excludes: so the command line takes precedence, and one parser validates all.

use super::{Explain, Failure};
use clap::{Arg, ArgAction, ArgMatches, Command, parser::ValueSource};
use serde_json::{Map, Value};
use std::{
    collections::BTreeSet,
    ffi::OsString,
    fmt::Write,
    path::{Path, PathBuf},
};

/// Name of the default configuration file, in the current folder.
const DEFAULT_FILE: &str = "cv.toml";

/// A command line completed from a configuration file.
pub(crate) struct Completed {
    /// The program's name and all arguments.
    pub(crate) args: Vec<OsString>,
    /// The options taken from the file, as a message.
    pub(crate) note: Option<String>,
    /// The output of `--print-config`.
    pub(crate) printed: Option<String>,
}

/// Adds the options of the file, if there is one, to a command line.
pub(crate) fn complete(program: &Command, mut args: Vec<OsString>) -> Result<Completed, Failure> {
    let mut built = program.clone();
    built.build();
    // Errors in the command line, and help, are left to the parser that follows.
    let Ok(matches) = program.clone().ignore_errors(true).try_get_matches_from(&args) else {
        return Ok(Completed { args, note: None, printed: None });
    };
    let named = matches.get_one::<PathBuf>("config").cloned();
    let file = named.or_else(|| Some(PathBuf::from(DEFAULT_FILE)).filter(|file| file.is_file()));
    let mut words = Vec::new();
    if let Some(file) = &file {
        let table = read(file)?;
        check(&built, &table, file)?;
        words = missing(&built, &matches, &table).during(file.display())?;
    }
    let end = args.iter().position(|word| word == "--").unwrap_or(args.len());
    args.splice(end..end, words.iter().map(OsString::from));
    let note = file.filter(|_| !words.is_empty()).map(|file| format!("{}: {}", file.display(), words.join(" ")));
    let printed = matches.get_flag("print_config").then(|| print(&built, &without_required(program.clone()), &args));
    Ok(Completed { args, note, printed: printed.flatten() })
}

fn read(file: &Path) -> Result<Map<String, Value>, Failure> {
    let bytes = cv_io::read_bytes(file)?;
    basic_toml::from_slice(&bytes).during(format!("{} is not valid TOML", file.display()))
}

/// Finds an option by its long name.
fn option<'c>(command: &'c Command, key: &str) -> Option<&'c Arg> {
    let own = ["config", "print-config", "help", "version"];
    command.get_arguments().find(|arg| arg.get_long() == Some(key) && !own.contains(&key))
}

/// Refuses unknown keys and tables.
fn check(command: &Command, table: &Map<String, Value>, file: &Path) -> Result<(), Failure> {
    for (key, value) in table {
        let name = command.get_bin_name().unwrap_or("cv");
        let inner = command.find_subcommand(key);
        match (value, inner) {
            (Value::Object(table), Some(inner)) => check(inner, table, file)?,
            (Value::Object(_), None) => {
                return Err(Failure::usage(format!("{}: `{name}` has no command “{key}”", file.display()))
                    .advice(format!("{name} --help")));
            }
            _ if option(command, key).is_none() => {
                return Err(Failure::usage(format!("{}: `{name}` has no option “{key}”", file.display()))
                    .advice(format!("{name} --help lists its options")));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Returns the arguments of the file that the command line neither gives nor excludes; those of the innermost command first.
fn missing(program: &Command, matches: &ArgMatches, table: &Map<String, Value>) -> Result<Vec<String>, Failure> {
    let mut levels = vec![(program, matches, table)];
    while let Some(&(command, matches, table)) = levels.last() {
        let Some((name, matches)) = matches.subcommand() else { break };
        let (Some(command), Some(Value::Object(table))) = (command.find_subcommand(name), table.get(name)) else {
            break;
        };
        levels.push((command, matches, table));
    }
    let (mut words, mut known) = (Vec::new(), BTreeSet::new());
    for (command, matches, table) in levels.into_iter().rev() {
        let given = |arg: &Arg| {
            matches!(matches.try_contains_id(arg.get_id().as_str()), Ok(true))
                && matches.value_source(arg.get_id().as_str()) == Some(ValueSource::CommandLine)
        };
        for (key, value) in table {
            let Some(arg) = option(command, key).filter(|arg| !given(arg)) else { continue };
            let excluded = command.get_arguments().filter(|other| given(other)).any(|other| {
                let both = [(arg, other), (other, arg)];
                both.into_iter()
                    .any(|(a, b)| command.get_arg_conflicts_with(a).iter().any(|c| c.get_id() == b.get_id()))
            });
            if !excluded && known.insert(key) {
                push(&mut words, arg, key, value)?;
            }
        }
    }
    Ok(words)
}

/// Appends an option as arguments of the command line.
fn push(words: &mut Vec<String>, arg: &Arg, key: &str, value: &Value) -> Result<(), Failure> {
    let flag = matches!(arg.get_action(), ArgAction::SetTrue);
    match value {
        Value::Bool(on) if flag => words.extend(on.then(|| format!("--{key}"))),
        _ if flag => return Err(Failure::usage(format!("{key} must be true or false, not {value}"))),
        Value::String(text) => words.push(format!("--{key}={text}")),
        Value::Array(list) => list.iter().try_for_each(|value| push(words, arg, key, value))?,
        other => words.push(format!("--{key}={other}")),
    }
    Ok(())
}

/// Returns the command with no required arguments.
fn without_required(command: Command) -> Command {
    command.mut_args(|arg| arg.required(false)).mut_subcommands(without_required).subcommand_required(false)
}

/// Formats the effective options as a configuration file, with defaults as comments; `None` if the command line is invalid.
fn print(built: &Command, program: &Command, args: &[OsString]) -> Option<String> {
    let matches = program.clone().try_get_matches_from(args).ok()?;
    let (mut text, mut level) = (String::new(), Some((built, &matches, Vec::new())));
    let mut globals = BTreeSet::new();
    while let Some((command, matches, path)) = level {
        if !path.is_empty() {
            let _ = writeln!(text, "\n[{}]", path.join("."));
        }
        for arg in command.get_arguments() {
            let Some(key) = arg.get_long().filter(|key| option(command, key).is_some()) else { continue };
            let id = arg.get_id().as_str();
            // Global options are printed first.
            if path.is_empty() && !globals.insert(id) || !path.is_empty() && globals.contains(id) {
                continue;
            }
            let Ok(Some(values)) = matches.try_get_raw(id) else { continue };
            let values: Vec<String> = values.map(|value| toml(&value.to_string_lossy())).collect();
            // Defaults are comments: given explicitly, they could require other options or exclude them.
            let default = if matches.value_source(id) == Some(ValueSource::DefaultValue) { "# " } else { "" };
            let _ = match &values[..] {
                [one] => writeln!(text, "{default}{key} = {one}"),
                many => writeln!(text, "{default}{key} = [{}]", many.join(", ")),
            };
        }
        level = matches.subcommand().and_then(|(name, matches)| {
            Some((command.find_subcommand(name)?, matches, [path, vec![name.to_owned()]].concat()))
        });
    }
    Some(text)
}

/// Formats a value as TOML.
fn toml(text: &str) -> String {
    let bare =
        text.parse::<bool>().is_ok() || text.parse::<f64>().is_ok_and(f64::is_finite) && !text.starts_with(['+', '.']);
    if bare { text.to_owned() } else { Value::from(text).to_string() }
}
