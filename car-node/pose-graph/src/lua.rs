//! Reads a team's Lua configuration of Cartographer.
//!
//! Only what such files consist of is read: assignments to paths, tables, numbers, flags, names of other values, and
//! arithmetic. `include`, `return` and comments are skipped. No code is run.

use std::collections::BTreeMap;

use localizer::ParameterFault;
use serde_json::Value;

use crate::parameters::PoseGraphParameters;

/// What a file comes to.
#[derive(Debug, Clone, PartialEq)]
pub struct LuaConfiguration {
    /// The set: Cartographer's defaults with the file's values.
    pub parameters: PoseGraphParameters,
    /// Values in the file that localization on a known map has no use for, as paths in lower case.
    pub ignored: Vec<String>,
    /// All values in the file, by their paths in lower case.
    pub values: BTreeMap<String, Value>,
    /// Files that it includes. They are not read: Cartographer's own are the defaults.
    pub includes: Vec<String>,
}

/// Largest file \[bytes\].
const LARGEST: usize = 1 << 20;

/// Deepest nesting of tables and parentheses.
const DEEPEST: usize = 32;

impl LuaConfiguration {
    /// Reads the text of a file. A fault names the line.
    pub fn parse(text: &str) -> Result<Self, Vec<ParameterFault>> {
        if text.len() > LARGEST {
            let fault = format!("{} bytes are too many for a configuration", text.len());
            return Err(vec![line_fault(1, fault)]);
        }
        let tokens = tokens(text).map_err(|fault| vec![fault])?;
        let defaults = PoseGraphParameters::default();
        let mut reader = Reader {
            tokens,
            at: 0,
            values: numbers(&defaults),
            set: BTreeMap::new(),
            includes: Vec::new(),
        };
        reader.file().map_err(|fault| vec![fault])?;
        let known = defaults.to_values();
        let (mut given, mut ignored) = (Vec::new(), Vec::new());
        let mut values = BTreeMap::new();
        for (path, value) in reader.set {
            let key = set_key(&path);
            let value = if let Some(default) = known.get(key) {
                let value = as_default(value, default);
                given.push((key.to_owned(), value.clone()));
                value
            } else {
                ignored.push(path.clone());
                as_default(value, &Value::from(0))
            };
            values.insert(path, value);
        }
        let (parameters, _) = defaults.with_values(given)?;
        Ok(Self {
            parameters,
            ignored,
            values,
            includes: reader.includes,
        })
    }
}

/// The key of a set that a path in a file means.
fn set_key(path: &str) -> &str {
    path.strip_prefix("options.").unwrap_or(path)
}

/// A value as JSON, as whole number where the default is one.
fn as_default(value: Literal, default: &Value) -> Value {
    match value {
        Literal::Flag(flag) => flag.into(),
        Literal::Number(number) if default.is_u64() && number >= 0.0 && number.fract() == 0.0 => {
            (number as u64).into()
        }
        Literal::Number(number) => number.into(),
        Literal::Text(text) => text.into(),
    }
}

/// The defaults, for a file that multiplies one.
fn numbers(defaults: &PoseGraphParameters) -> BTreeMap<String, f64> {
    let values = defaults.to_values().into_iter();
    values
        .filter_map(|(key, value)| Some((key, value.as_f64()?)))
        .collect()
}

#[derive(Debug, Clone, PartialEq)]
enum Literal {
    Number(f64),
    Flag(bool),
    Text(String),
}

#[derive(Debug, Clone, PartialEq)]
enum Token {
    Name(String),
    Number(f64),
    Text(String),
    Sign(char),
}

fn line_fault(line: usize, fault: String) -> ParameterFault {
    ParameterFault {
        key: format!("line {line}"),
        fault,
    }
}

/// The tokens, each with its line.
fn tokens(text: &str) -> Result<Vec<(usize, Token)>, ParameterFault> {
    let characters: Vec<char> = text.chars().collect();
    let (mut tokens, mut i, mut line) = (Vec::new(), 0, 1);
    let at = |i: usize| characters.get(i).copied();
    while let Some(c) = at(i) {
        let begin = i;
        match c {
            '\n' => {
                line += 1;
                i += 1;
            }
            c if c.is_whitespace() || c == ';' => i += 1,
            '-' if at(i + 1) == Some('-') => {
                let long = at(i + 2) == Some('[') && at(i + 3) == Some('[');
                while let Some(c) = at(i) {
                    if long && c == ']' && at(i + 1) == Some(']') {
                        i += 2;
                        break;
                    }
                    if c == '\n' {
                        if !long {
                            break;
                        }
                        line += 1;
                    }
                    i += 1;
                }
            }
            '"' | '\'' => {
                i += 1;
                while at(i).is_some_and(|end| end != c && end != '\n') {
                    i += 1;
                }
                if at(i) != Some(c) {
                    return Err(line_fault(line, "a text without an end".into()));
                }
                tokens.push((line, Token::Text(characters[begin + 1..i].iter().collect())));
                i += 1;
            }
            c if c.is_ascii_digit() || (c == '.' && at(i + 1).is_some_and(|c| c.is_ascii_digit())) => {
                while at(i).is_some_and(|c| c.is_ascii_alphanumeric() || c == '.')
                    || at(i).is_some_and(|c| c == '-' || c == '+') && matches!(characters[i - 1], 'e' | 'E')
                {
                    i += 1;
                }
                let text: String = characters[begin..i].iter().collect();
                let number = text
                    .parse()
                    .map_err(|_| line_fault(line, format!("{text:?} is no number")))?;
                tokens.push((line, Token::Number(number)));
            }
            c if c.is_alphabetic() || c == '_' => {
                while at(i).is_some_and(|c| c.is_alphanumeric() || c == '_') {
                    i += 1;
                }
                tokens.push((line, Token::Name(characters[begin..i].iter().collect())));
            }
            '=' | '.' | ',' | '{' | '}' | '(' | ')' | '+' | '-' | '*' | '/' | '[' | ']' => {
                tokens.push((line, Token::Sign(c)));
                i += 1;
            }
            c => return Err(line_fault(line, format!("{c:?} is not understood here"))),
        }
    }
    Ok(tokens)
}

struct Reader {
    tokens: Vec<(usize, Token)>,
    at: usize,
    /// What a name may refer to.
    values: BTreeMap<String, f64>,
    /// What the file sets.
    set: BTreeMap<String, Literal>,
    /// Files that it includes.
    includes: Vec<String>,
}

/// A table or a name of one has no value of its own.
type Assigned = Option<Literal>;

impl Reader {
    fn file(&mut self) -> Result<(), ParameterFault> {
        while let Some(token) = self.peek().cloned() {
            match token {
                Token::Name(name) if name == "include" => {
                    self.at += 1;
                    let Some(Token::Text(file)) = self.peek().cloned() else {
                        return Err(self.fault("include needs the name of a file"));
                    };
                    self.includes.push(file);
                    self.at += 1;
                }
                Token::Name(name) if name == "return" => return Ok(()),
                Token::Name(name) if name == "local" => self.at += 1,
                Token::Name(_) => {
                    let path = self.path()?;
                    self.expect('=')?;
                    self.assign(&path, 0)?;
                }
                _ => return Err(self.fault("an assignment should begin here")),
            }
        }
        Ok(())
    }

    fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.at).map(|(_, token)| token)
    }

    fn fault(&self, fault: &str) -> ParameterFault {
        let at = self.at.min(self.tokens.len().saturating_sub(1));
        let line = self.tokens.get(at).map_or(1, |(line, _)| *line);
        let found = match self.peek() {
            None => "the file ends".into(),
            Some(Token::Name(name)) => format!("found {name:?}"),
            Some(Token::Number(number)) => format!("found {number}"),
            Some(Token::Text(text)) => format!("found {text:?}"),
            Some(Token::Sign(sign)) => format!("found {sign:?}"),
        };
        line_fault(line, format!("{fault}; {found}"))
    }

    fn takes(&mut self, sign: char) -> bool {
        let there = self.peek() == Some(&Token::Sign(sign));
        self.at += usize::from(there);
        there
    }

    fn expect(&mut self, sign: char) -> Result<(), ParameterFault> {
        if self.takes(sign) {
            return Ok(());
        }
        Err(self.fault(&format!("{sign:?} should stand here")))
    }

    /// A path in lower case.
    fn path(&mut self) -> Result<String, ParameterFault> {
        let mut path = String::new();
        loop {
            let Some(Token::Name(name)) = self.peek() else {
                return Err(self.fault("a name should stand here"));
            };
            path += &name.to_lowercase();
            self.at += 1;
            if !self.takes('.') {
                return Ok(path);
            }
            path.push('.');
        }
    }

    fn assign(&mut self, path: &str, depth: usize) -> Result<(), ParameterFault> {
        if depth > DEEPEST {
            return Err(self.fault("the nesting is too deep"));
        }
        if !self.takes('{') {
            if let Some(value) = self.value(depth)? {
                if let Literal::Number(number) = value {
                    self.values.insert(path.into(), number);
                }
                self.set.insert(path.into(), value);
            }
            return Ok(());
        }
        while !self.takes('}') {
            // Items without a name are no parameters.
            if matches!(self.tokens.get(self.at + 1), Some((_, Token::Sign('='))))
                && matches!(self.peek(), Some(Token::Name(_)))
            {
                let key = self.path()?;
                self.expect('=')?;
                self.assign(&format!("{path}.{key}"), depth + 1)?;
            } else {
                self.value(depth + 1)?;
            }
            if !self.takes(',') {
                self.expect('}')?;
                return Ok(());
            }
        }
        Ok(())
    }

    fn value(&mut self, depth: usize) -> Result<Assigned, ParameterFault> {
        match self.peek().cloned() {
            Some(Token::Text(text)) => {
                self.at += 1;
                Ok(Some(Literal::Text(text)))
            }
            Some(Token::Name(name)) if name == "true" || name == "false" => {
                self.at += 1;
                Ok(Some(Literal::Flag(name == "true")))
            }
            Some(Token::Name(name)) if name == "nil" => {
                self.at += 1;
                Ok(None)
            }
            _ => Ok(self.sum(depth)?.map(Literal::Number)),
        }
    }

    /// None where a name without a number takes part, such as that of a table.
    fn sum(&mut self, depth: usize) -> Result<Option<f64>, ParameterFault> {
        let mut sum = self.product(depth)?;
        loop {
            let sign = if self.takes('+') {
                1.0
            } else if self.takes('-') {
                -1.0
            } else {
                return Ok(sum);
            };
            let next = self.product(depth)?;
            sum = sum.zip(next).map(|(a, b)| a + sign * b);
        }
    }

    fn product(&mut self, depth: usize) -> Result<Option<f64>, ParameterFault> {
        let mut product = self.factor(depth)?;
        loop {
            if self.takes('*') {
                let next = self.factor(depth)?;
                product = product.zip(next).map(|(a, b)| a * b);
            } else if self.takes('/') {
                let next = self.factor(depth)?;
                product = product.zip(next).map(|(a, b)| a / b);
            } else {
                return Ok(product);
            }
        }
    }

    fn factor(&mut self, depth: usize) -> Result<Option<f64>, ParameterFault> {
        if depth > DEEPEST {
            return Err(self.fault("the nesting is too deep"));
        }
        if self.takes('-') {
            return Ok(self.factor(depth + 1)?.map(|number| -number));
        }
        if self.takes('(') {
            let inside = self.sum(depth + 1)?;
            self.expect(')')?;
            return Ok(inside);
        }
        match self.peek().cloned() {
            Some(Token::Number(number)) => {
                self.at += 1;
                Ok(Some(number))
            }
            Some(Token::Name(name)) if name == "math" => {
                let path = self.path()?;
                if path == "math.pi" {
                    return Ok(Some(std::f64::consts::PI));
                }
                self.expect('(')?;
                let inside = self.sum(depth + 1)?;
                self.expect(')')?;
                match path.as_str() {
                    "math.rad" => Ok(inside.map(f64::to_radians)),
                    "math.deg" => Ok(inside.map(f64::to_degrees)),
                    _ => Err(self.fault(&format!("{path} is not known"))),
                }
            }
            Some(Token::Name(_)) => {
                let path = self.path()?;
                Ok(self.values.get(&path).copied())
            }
            _ => Err(self.fault("a value should stand here")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEAM: &str = r#"
include "map_builder.lua"
options = {
  map_builder = MAP_BUILDER,
  map_frame = "map",   -- a comment
  odometry_sampling_ratio = 0.5,
  num_laser_scans = 1,
}
--[[ a long
comment ]]
MAP_BUILDER.use_trajectory_builder_2d = true
TRAJECTORY_BUILDER_2D.max_range = 25.
TRAJECTORY_BUILDER.pure_localization_trimmer = {
  max_submaps_to_keep = 5,
}
TRAJECTORY_BUILDER_2D.submaps.num_range_data = 80
TRAJECTORY_BUILDER_2D.motion_filter.max_angle_radians = math.rad(0.2)
TRAJECTORY_BUILDER_2D.ceres_scan_matcher.rotation_weight = 0.2 * TRAJECTORY_BUILDER_2D.ceres_scan_matcher.rotation_weight
POSE_GRAPH.constraint_builder.min_score = (1 - 2e-1) / 2
POSE_GRAPH.optimization_problem.odometry_rotation_weight = 0
TRAJECTORY_BUILDER_2D.use_online_correlative_scan_matching = true
return options
"#;

    #[test]
    fn a_teams_file_is_read() {
        let read = LuaConfiguration::parse(TEAM).expect("sound");
        let expected = PoseGraphParameters {
            odometry_sampling_ratio: 0.5,
            max_range: 25.0,
            max_submaps_to_keep: 5,
            submaps_num_range_data: 80,
            motion_filter_max_angle_radians: 0.2f64.to_radians(),
            matcher_rotation_weight: 8.0,
            min_score: 0.4,
            odometry_rotation_weight: 0.0,
            use_online_correlative_scan_matching: true,
            ..PoseGraphParameters::default()
        };
        assert_eq!(read.parameters, expected);
        let ignored = [
            "map_builder.use_trajectory_builder_2d",
            "options.map_frame",
            "options.num_laser_scans",
        ];
        assert_eq!(read.ignored, ignored);
        assert_eq!(read.includes, ["map_builder.lua"]);
        assert_eq!(read.values.len(), 12);
        assert_eq!(read.values["options.num_laser_scans"], 1);
        assert_eq!(
            read.values["trajectory_builder.pure_localization_trimmer.max_submaps_to_keep"],
            5
        );
    }

    #[test]
    fn a_fault_names_its_line() {
        for (text, key) in [
            ("A.b = 1\nA.c = = 2\n", "line 2"),
            ("A.b = {\n c = 1\n d = 2 }", "line 3"),
            ("x = 1 $ 2", "line 1"),
            ("x = \"open\n", "line 1"),
            ("x = 1e\n", "line 1"),
            (
                "TRAJECTORY_BUILDER_2D.max_range = -3",
                "trajectory_builder_2d.max_range",
            ),
            (
                "TRAJECTORY_BUILDER_2D.max_range = true",
                "trajectory_builder_2d.max_range",
            ),
            ("x =", "line 1"),
        ] {
            let faults = LuaConfiguration::parse(text).expect_err(text);
            assert_eq!(faults[0].key, key, "{text}: {faults:?}");
        }
        let deep = format!("x = {}1{}", "(".repeat(10_000), ")".repeat(10_000));
        assert!(LuaConfiguration::parse(&deep).is_err());
    }
}
