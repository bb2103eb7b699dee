//! `--config`: a TOML file that says what the flags of `bake` would.
//!
//! Every long flag is a key; a flag without value takes `true`. `[light.NAME]` and `[node.NAME]` are tables. What the
//! command line says itself wins. Paths are relative to the file.

use super::args::{CLEAR, Cli, light_word};
use clap::builder::Resettable;
use clap::parser::ValueSource;
use clap::{ArgAction, ArgMatches, Command, CommandFactory, Id};
use evenlight::BakeError;
use evenlight::scene::{BakeMode, Changes, LightChange, NodeChange};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Commands that take such a file.
const COMMANDS: [&str; 2] = ["bake", "plan"];

/// Largest file (bytes).
const MAX_BYTES: u64 = 1 << 20;

/// What a file adds to a command line.
#[derive(Debug, Default)]
pub struct Config {
    /// The file.
    path: PathBuf,
    /// Flags with the lines that they come from.
    flags: Vec<(String, usize)>,
    /// Changes to the scene, before those of the command line.
    pub changes: Changes,
}

/// The command line with what its `--config` adds, and that file, if there is one.
///
/// # Errors
/// [`BakeError::Options`] names the file, the line and the key.
pub fn expand(arguments: Vec<OsString>) -> Result<(Vec<OsString>, Option<Config>), BakeError> {
    let found = lenient().try_get_matches_from(&arguments);
    // What is wrong with the command line itself is said when it is parsed in earnest.
    let subcommand = found.ok().and_then(|m| m.subcommand().map(|(name, given)| (name.to_owned(), given.clone())));
    let Some((name, given)) = subcommand.filter(|(name, _)| COMMANDS.contains(&name.as_str())) else {
        return Ok((arguments, None));
    };
    let Some(path) = given.get_one::<PathBuf>("config").cloned() else { return Ok((arguments, None)) };
    let text = read(&path)?;
    let mut config = Config { path, ..Config::default() };
    let mut added = Vec::new();
    let table = DeTable::parse(&text).map_err(|e| {
        let line = line_of(&text, e.span().map_or(0, |s| s.start));
        BakeError::Options(format!("{}: line {line}: {}", config.path.display(), e.message()))
    })?;
    for (key, value) in in_order(table.get_ref()) {
        let at = At { config: &config.path, text: &text, key, place: key.span().start };
        match (key.get_ref().as_ref(), value.get_ref()) {
            ("light", DeValue::Table(lights)) => {
                let changes = at.lights(lights, &mut added)?;
                config.changes.lights.extend(changes);
            }
            ("node", DeValue::Table(nodes)) => config.changes.nodes.extend(at.nodes(nodes)?),
            (name, value) => {
                added.extend(at.flag(name, value, &given)?);
                config.flags.push((name.into(), line_of(&text, at.place)));
            }
        }
    }
    let command = arguments.iter().position(|a| *a == *name).map_or(arguments.len(), |i| i + 1);
    let mut all = arguments;
    all.splice(command..command, added);
    Ok((all, Some(config)))
}

impl Config {
    /// Names the file and the line in an error about a flag that comes from it.
    pub fn locate(&self, error: BakeError) -> BakeError {
        let BakeError::Options(what) = &error else { return error };
        let flag = what.strip_prefix("--").and_then(|rest| rest.split([' ', ':']).next());
        match self.flags.iter().find(|(name, _)| Some(name.as_str()) == flag) {
            Some((_, line)) => BakeError::Options(format!("{}: line {line}: {what}", self.path.display())),
            None => error,
        }
    }
}

/// The command line, but that everything may be left to the file.
fn lenient() -> Command {
    let unless = Resettable::<Id>::Reset;
    let optional = |bake: Command| {
        bake.mut_arg("out", |a| a.required(false))
            .mut_arg("scene", |a| a.required(false).required_unless_present(unless.clone()))
    };
    COMMANDS.into_iter().fold(Cli::command(), |all, command| all.mut_subcommand(command, optional))
}

fn read(path: &Path) -> Result<String, BakeError> {
    let fail = |why: String| BakeError::Options(format!("--config {}: {why}", path.display()));
    let found = std::fs::metadata(path).map_err(|e| fail(format!("cannot read it: {e}")))?;
    if !found.is_file() || found.len() > MAX_BYTES {
        return Err(fail(format!("must be a file of at most {} MiB", MAX_BYTES >> 20)));
    }
    std::fs::read_to_string(path).map_err(|e| fail(format!("cannot read it: {e}")))
}

/// Counted from 1.
fn line_of(text: &str, place: usize) -> usize {
    1 + text.bytes().take(place).filter(|&b| b == b'\n').count()
}

type Key<'t> = Spanned<std::borrow::Cow<'t, str>>;

/// Entries as the file has them, one after another: what is said last holds.
fn in_order<'a, 't>(table: &'a DeTable<'t>) -> Vec<(&'a Key<'t>, &'a Spanned<DeValue<'t>>)> {
    let mut all: Vec<_> = table.iter().collect();
    all.sort_by_key(|(key, _)| key.span().start);
    all
}

/// A place in the file.
struct At<'a> {
    config: &'a Path,
    text: &'a str,
    key: &'a Key<'a>,
    place: usize,
}

impl At<'_> {
    fn fail(&self, what: impl std::fmt::Display) -> BakeError {
        BakeError::Options(format!("{}: line {}: {what}", self.config.display(), line_of(self.text, self.place)))
    }

    /// The same place, but for what `key` says.
    fn inner<'b>(&'b self, key: &'b Key<'b>) -> At<'b> {
        At { config: self.config, text: self.text, key, place: key.span().start }
    }

    fn path(&self, text: &str) -> PathBuf {
        self.config.parent().unwrap_or(Path::new("")).join(text)
    }

    /// Arguments for an option; none where the command line has it.
    fn flag(&self, name: &str, value: &DeValue, given: &ArgMatches) -> Result<Vec<OsString>, BakeError> {
        let command = lenient();
        let bake = command.find_subcommand("bake").map(Command::get_arguments).into_iter().flatten();
        let options: Vec<_> = bake.filter(|a| !["config", "help"].contains(&a.get_id().as_str())).collect();
        let Some(option) = options.iter().find(|a| a.get_long() == Some(name) || a.is_positional() && name == "scene")
        else {
            let near = options.iter().filter_map(|a| a.get_long()).chain(["scene", "light.NAME", "node.NAME"]);
            let all: Vec<&str> = near.collect();
            return Err(self.fail(format!("`bake` has no option `{name}`; it has {}", all.join(", "))));
        };
        let switch = matches!(option.get_action(), ArgAction::SetTrue);
        let many = matches!(option.get_action(), ArgAction::Append) && name != "scene";
        let there = given.value_source(option.get_id().as_str()) == Some(ValueSource::CommandLine);
        let values: Vec<String> = match value {
            DeValue::Boolean(on) if switch => {
                return Ok(if *on && !there { vec![format!("--{name}").into()] } else { Vec::new() });
            }
            _ if switch => return Err(self.fail(format!("`{name}` takes true or false"))),
            DeValue::Array(items) if many => {
                let each = |item: &Spanned<DeValue>| self.scalar(name, item.get_ref());
                items.iter().map(each).collect::<Result<_, _>>()?
            }
            one => vec![self.scalar(name, one)?],
        };
        let mut arguments = Vec::new();
        for value in values {
            let value = if is_path(name, &value) { self.path(&value).into_os_string() } else { value.into() };
            let mut argument = OsString::from(if name == "scene" { String::new() } else { format!("--{name}=") });
            argument.push(value);
            arguments.push(argument);
        }
        // Each by itself, so that what is wrong with it is said of its line.
        let trial = ["evenlight", "bake"].map(OsString::from).into_iter().chain(arguments.iter().cloned());
        if let Err(e) = lenient().try_get_matches_from(trial) {
            let said = e.to_string();
            let first = said.lines().next().unwrap_or_default();
            return Err(self.fail(first.strip_prefix("error: ").unwrap_or(first)));
        }
        // Lists of changes go before those of the command line; all else it replaces.
        let adds = ["light", "ies", "group"].contains(&name);
        Ok(if there && !adds { Vec::new() } else { arguments })
    }

    fn scalar(&self, name: &str, value: &DeValue) -> Result<String, BakeError> {
        match value {
            DeValue::String(text) => Ok(text.clone().into_owned()),
            DeValue::Integer(number) => Ok(number.as_str().into()),
            DeValue::Float(number) => Ok(number.as_str().into()),
            other => Err(self.fail(format!("`{name}` takes a text or a number, not a {}", other.type_str()))),
        }
    }

    fn number(&self, value: &DeValue) -> Result<f32, BakeError> {
        let text = match value {
            DeValue::Integer(number) => number.as_str(),
            DeValue::Float(number) => number.as_str(),
            _ => "",
        };
        text.parse().map_err(|_| self.fail(format!("`{}` takes a number", self.key.get_ref())))
    }

    fn switch(&self, value: &DeValue) -> Result<bool, BakeError> {
        value.as_bool().ok_or_else(|| self.fail(format!("`{}` takes true or false", self.key.get_ref())))
    }

    /// `[light.NAME]` with `bake`, `scale`, `ies` and `group`, or `light.NAME` as in `--light`. Groups are added to
    /// `arguments`.
    fn lights(&self, table: &DeTable, arguments: &mut Vec<OsString>) -> Result<Vec<(String, LightChange)>, BakeError> {
        let mut changes = Vec::new();
        for (name, value) in in_order(table) {
            let at = self.inner(name);
            let mut group = None;
            let change = match value.get_ref() {
                DeValue::Table(keys) => at.light(keys, &mut group)?,
                DeValue::String(word) => LightChange { bake: Some(at.bake_mode(word)?), ..LightChange::default() },
                number => LightChange { scale: Some(at.number(number)?), ..LightChange::default() },
            };
            let name = name.get_ref();
            let grouped = group.is_some();
            arguments.extend(group.map(|group| format!("--group={group}={name}").into()));
            // `sun` and `sky`, which are none of the scene's, may have a group and no more.
            if !grouped || change != LightChange::default() {
                changes.push((name.clone().into_owned(), change));
            }
        }
        Ok(changes)
    }

    fn light(&self, keys: &DeTable, group: &mut Option<String>) -> Result<LightChange, BakeError> {
        let mut change = LightChange::default();
        for (key, value) in in_order(keys) {
            let at = self.inner(key);
            match (key.get_ref().as_ref(), value.get_ref()) {
                ("bake", DeValue::String(word)) => change.bake = Some(at.bake_mode(word)?),
                ("bake", value) => change.bake = Some(if at.switch(value)? { BakeMode::Full } else { BakeMode::Off }),
                ("scale", value) => change.scale = Some(at.number(value)?),
                ("ies", DeValue::String(file)) => change.ies = Some(at.path(file)),
                ("ies", _) => return Err(at.fail("`ies` takes the name of a file")),
                ("group", DeValue::String(name)) => *group = Some(name.clone().into_owned()),
                ("group", _) => return Err(at.fail("`group` takes a name")),
                (other, _) => {
                    return Err(at.fail(format!("a light has no `{other}`; it has bake, scale, ies and group")));
                }
            }
        }
        Ok(change)
    }

    fn bake_mode(&self, word: &str) -> Result<BakeMode, BakeError> {
        light_word(word).ok_or_else(|| self.fail(format!("a light is baked full, indirect or off, not `{word}`")))
    }

    /// `[node.NAME]`.
    fn nodes(&self, table: &DeTable) -> Result<Vec<(String, NodeChange)>, BakeError> {
        let mut out = Vec::new();
        for (name, value) in in_order(table) {
            let at = self.inner(name);
            let Some(keys) = value.get_ref().as_table() else {
                return Err(at.fail("a node takes a table, such as `{ weight = 0.5 }`"));
            };
            out.push((name.get_ref().clone().into_owned(), at.node(keys)?));
        }
        Ok(out)
    }

    fn node(&self, keys: &DeTable) -> Result<NodeChange, BakeError> {
        let mut change = NodeChange::default();
        for (key, value) in in_order(keys) {
            let at = self.inner(key);
            let value = value.get_ref();
            match key.get_ref().as_ref() {
                "weight" => change.weight = Some(at.number(value)?),
                "density" => change.density = Some(at.number(value)?),
                "casts" => change.casts = Some(at.switch(value)?),
                // Two words for one thing, as in the extras: either can say no.
                "bake" | "receives" => change.bake = Some(change.bake.unwrap_or(true) && at.switch(value)?),
                other => {
                    let has = "it has weight, density, bake, casts and receives";
                    return Err(at.fail(format!("a node has no `{other}`; {has}")));
                }
            }
        }
        Ok(change)
    }
}

/// Whether the value of an option names a file.
fn is_path(name: &str, value: &str) -> bool {
    match name {
        "scene" | "out" | "cache" | "plan" => true,
        "sky" => !value.starts_with(CLEAR) && !value.split(',').all(|n| n.trim().parse::<f32>().is_ok()),
        _ => false,
    }
}
