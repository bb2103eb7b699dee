//! IES photometric files: text in, a table of candela out.
//!
//! ANSI/IES LM-63, the editions of 1986, 1991, 1995, 2002 and 2019, as far as they say where light goes; keywords and
//! the size of the luminous opening are read over. After Ashdown, "Parsing the IESNA LM-63 photometric data file",
//! 1998, where the editions leave something open.

use std::fmt;

/// Largest file that is read (bytes). A table of half degrees over the whole sphere takes 2 MB.
pub(super) const MAX_BYTES: u64 = 32 << 20;

/// Most values of a table: steps of a quarter of a degree over the whole sphere.
const MAX_VALUES: usize = 1 << 20;

/// What is wrong, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    /// Counted from 1.
    pub(super) line: usize,
    /// Fault and cure.
    pub(super) what: String,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.what)
    }
}

/// Which way the angles are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Web {
    /// Type C: the vertical angle from straight down, the horizontal one around that axis.
    C,
    /// Types A and B: the vertical angle from the equator, the horizontal one along it.
    AOrB,
}

/// What a file says.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Table {
    pub(super) web: Web,
    /// Vertical angles (degrees), ascending, two at least.
    pub(super) vertical: Vec<f64>,
    /// Horizontal angles (degrees), ascending, one at least.
    pub(super) horizontal: Vec<f64>,
    /// Intensity (cd), from 0, with all factors of the file: a row of verticals for each horizontal angle.
    pub(super) candela: Vec<f64>,
    /// Angles (degrees) that the luminaire is tilted by, ascending, with what each leaves of its light; empty where
    /// that does not matter.
    pub(super) tilt: Vec<[f64; 2]>,
    /// Rated flux of all lamps (lm) where photometry is relative; `None` where it is absolute.
    pub(super) lamp_lumens: Option<f64>,
    /// What is odd but usable.
    pub(super) odd: Vec<String>,
}

/// Editions that differ in what their numbers mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Edition {
    /// 1986 and 1991: the second factor is the ballast-lamp photometric factor.
    Early,
    /// 1995 and 2002: it is for future use, and 1.
    Middle,
    /// 2019: it says how the file was made.
    Late,
}

/// Reads the contents of a file. `tilt_file` gives those of the file that a line `TILT=name` names.
pub(super) fn parse(bytes: &[u8], tilt_file: impl FnOnce(&str) -> Result<Vec<u8>, String>) -> Result<Table, Fault> {
    let text = plain_lines(bytes);
    let (edition, tilt_line, name) = header(&text)?;
    let mut numbers = Numbers::new(&text, tilt_line);
    let mut odd = Vec::new();
    let tilt = match name {
        "NONE" => Vec::new(),
        "INCLUDE" => tilt(&mut numbers)?,
        file => {
            let fault = |what: String| Fault { line: tilt_line, what: format!("TILT={file}: {what}") };
            let text = plain_lines(&tilt_file(file).map_err(fault)?);
            tilt(&mut Numbers::new(&text, 0)).map_err(|f| fault(format!("in that file, {f}")))?
        }
    };
    let lamps = numbers.next("the number of lamps")?;
    let lumens = numbers.next("the lumens per lamp")?;
    let multiplier = numbers.factor("the candela multiplier")?;
    let vertical_count = numbers.count("the number of vertical angles", 2)?;
    let horizontal_count = numbers.count("the number of horizontal angles", 1)?;
    let values = vertical_count.checked_mul(horizontal_count).filter(|&n| n <= MAX_VALUES);
    let Some(values) = values else {
        return Err(numbers.fault(format!(
            "{vertical_count} x {horizontal_count} angles are more than the {MAX_VALUES} values that are read; \
             export the file with wider steps"
        )));
    };
    let web = match numbers.next("the photometric type")? {
        1.0 => Web::C,
        2.0 | 3.0 => Web::AOrB,
        other => {
            let what = "is none of 1 (type C), 2 (type B) and 3 (type A); ask the maker for a file of type C";
            return Err(numbers.fault(format!("the photometric type {other} {what}")));
        }
    };
    for what in ["the units type", "the width", "the length", "the height"] {
        numbers.next(what)?;
    }
    let ballast = numbers.factor("the ballast factor")?;
    let second = numbers.next("the second factor after the ballast's")?;
    let second = match edition {
        Edition::Early => numbers.not_negative("the ballast-lamp photometric factor", second)?,
        Edition::Middle if second != 1.0 => {
            odd.push(format!("the number after the ballast factor is {second}, though reserved; it is not used"));
            1.0
        }
        _ => 1.0,
    };
    numbers.next("the input watts")?;

    let vertical = numbers.angles("vertical", vertical_count)?;
    let horizontal = numbers.angles("horizontal", horizontal_count)?;
    numbers.enough(values, "candela values")?;
    let factor = multiplier * ballast * second;
    let (mut candela, mut negative) = (Vec::with_capacity(values), 0);
    for _ in 0..values {
        let value = numbers.next("a candela value")? * factor;
        // More cannot be told from a fault, and would be infinite as 32-bit float.
        if value > 1e30 {
            return Err(numbers.fault(format!("an intensity of {value} cd is no lamp's; check the candela multiplier")));
        }
        negative += usize::from(value < 0.0);
        candela.push(value.max(0.0));
    }
    if negative > 0 {
        odd.push(format!("{negative} candela values are below 0 and taken as 0"));
    }
    if numbers.next("more").is_ok() {
        odd.push("there are numbers after the last candela value; they are not used".into());
    }
    let lamp_lumens = (lumens >= 0.0 && lamps > 0.0).then_some(lamps * lumens);
    Ok(Table { web, vertical, horizontal, candela, tilt, lamp_lumens, odd })
}

/// The text with one kind of line end. What is not UTF-8, as in names of makers, is replaced.
fn plain_lines(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).replace("\r\n", "\n").replace('\r', "\n")
}

/// The edition, and number and value of the line `TILT=`.
fn header(text: &str) -> Result<(Edition, usize, &str), Fault> {
    let first = text.trim_start_matches('\u{feff}').lines().next().unwrap_or_default().trim();
    let edition = if first.contains("LM-63-2019") {
        Edition::Late
    } else if first.contains("LM-63-1995") || first.contains("LM-63-2002") {
        Edition::Middle
    } else {
        // The edition of 1986 has no line for itself.
        Edition::Early
    };
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        let Some((key, value)) = line.split_once('=') else { continue };
        if key.trim().eq_ignore_ascii_case("TILT") {
            let value = value.trim();
            let known = ["NONE", "INCLUDE"].into_iter().find(|k| value.eq_ignore_ascii_case(k));
            return match known.unwrap_or(value) {
                "" => {
                    Err(Fault { line: i + 1, what: "TILT= names nothing; write TILT=NONE if the lamp may tilt".into() })
                }
                value => Ok((edition, i + 1, value)),
            };
        }
    }
    let what = "has no line TILT=, so it is no IES file (LM-63); give the .ies file of a luminaire";
    Err(Fault { line: text.lines().count().max(1), what: what.into() })
}

/// The table of a lamp whose light depends on how it is tilted.
fn tilt(numbers: &mut Numbers) -> Result<Vec<[f64; 2]>, Fault> {
    let geometry = numbers.next("the lamp-to-luminaire geometry")?;
    if ![1.0, 2.0, 3.0].contains(&geometry) {
        return Err(numbers.fault(format!("the lamp-to-luminaire geometry {geometry} is none of 1, 2 and 3; {MEND}")));
    }
    let count = numbers.count("the number of tilt angles", 1)?;
    let angles = numbers.angles("tilt", count)?;
    numbers.enough(count, "tilt factors")?;
    angles.into_iter().map(|angle| Ok([angle, numbers.factor("a tilt factor")?])).collect()
}

const MEND: &str = "ask the maker for the file anew, or mend it by hand";

/// The numbers of a text, one after another over all lines.
struct Numbers<'t> {
    tokens: Box<dyn Iterator<Item = (usize, &'t str)> + 't>,
    /// Line of the last number.
    line: usize,
    /// Characters still to come at most, two for each number.
    left: usize,
}

impl<'t> Numbers<'t> {
    /// Those after the first `skip` lines.
    fn new(text: &'t str, skip: usize) -> Numbers<'t> {
        let split = |c: char| c.is_whitespace() || c == ',';
        let tokens = text
            .lines()
            .enumerate()
            .skip(skip)
            .flat_map(move |(i, line)| line.split(split).filter(|t| !t.is_empty()).map(move |t| (i + 1, t)));
        Numbers { tokens: Box::new(tokens), line: skip.max(1), left: text.len() + 1 }
    }

    fn fault(&self, what: String) -> Fault {
        Fault { line: self.line, what }
    }

    fn next(&mut self, what: &str) -> Result<f64, Fault> {
        let Some((line, token)) = self.tokens.next() else {
            return Err(self.fault(format!("the file ends where {what} should be; {MEND}")));
        };
        self.line = line;
        self.left = self.left.saturating_sub(token.len() + 1);
        match token.parse::<f64>() {
            Ok(x) if x.is_finite() => Ok(x),
            _ => {
                let shown: String = token.chars().take(24).collect();
                Err(self.fault(format!("'{shown}' where {what} should be is no number; {MEND}")))
            }
        }
    }

    fn not_negative(&self, what: &str, x: f64) -> Result<f64, Fault> {
        if x >= 0.0 { Ok(x) } else { Err(self.fault(format!("{what} is {x}, below 0; {MEND}"))) }
    }

    fn factor(&mut self, what: &str) -> Result<f64, Fault> {
        let x = self.next(what)?;
        self.not_negative(what, x)
    }

    fn count(&mut self, what: &str, least: usize) -> Result<usize, Fault> {
        let x = self.next(what)?;
        if x.fract() != 0.0 || x < least as f64 || x > MAX_VALUES as f64 {
            return Err(self.fault(format!("{what} is {x}, not a whole number of {least} to {MAX_VALUES}; {MEND}")));
        }
        Ok(x as usize)
    }

    /// Refuses to make room for more numbers than the file can hold.
    fn enough(&self, count: usize, what: &str) -> Result<(), Fault> {
        if count <= self.left / 2 + 1 {
            return Ok(());
        }
        Err(self.fault(format!("{count} {what} are announced, more than the rest of the file can hold; {MEND}")))
    }

    fn angles(&mut self, kind: &str, count: usize) -> Result<Vec<f64>, Fault> {
        self.enough(count, &format!("{kind} angles"))?;
        let mut angles: Vec<f64> = Vec::with_capacity(count);
        for _ in 0..count {
            let x = self.next(&format!("a {kind} angle"))?;
            if x.abs() > 360.0 {
                return Err(self.fault(format!("the {kind} angle {x} is beyond 360 degrees; {MEND}")));
            }
            if angles.last().is_some_and(|&before| x <= before) {
                let before = angles[angles.len() - 1];
                return Err(self.fault(format!("the {kind} angle {x} follows {before}; angles must ascend; {MEND}")));
            }
            angles.push(x);
        }
        Ok(angles)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn no_file(name: &str) -> Result<Vec<u8>, String> {
        Err(format!("{name} is not there"))
    }

    fn table(text: &str) -> Table {
        parse(text.as_bytes(), no_file).expect("a good file")
    }

    /// 2 x 800 lm, multiplier 2, verticals 0, 45, 90, horizontals 0, 90; ballast factor 0.5, then `second`.
    fn file(first: &str, second: f64) -> String {
        format!(
            "{first}\n[TEST] = none\nTILT=NONE\n2 800 2 3 2 1 2 0 0 0\n0.5 {second} 40\n0 45 90\n0 90\n\
             100 50 10\n80, 40 , 0\n"
        )
    }

    #[test]
    fn all_factors_of_the_edition_count() {
        for (first, second, factor) in [
            ("IESNA91", 0.9, 0.9),
            ("a keyword of 1986", 0.9, 0.9),
            ("IESNA:LM-63-1995", 1.0, 1.0),
            ("IESNA:LM-63-2002", 0.9, 1.0),
            ("IES:LM-63-2019", 1.00001, 1.0),
        ] {
            let t = table(&file(first, second));
            assert_eq!((t.web, t.lamp_lumens), (Web::C, Some(1600.0)));
            assert_eq!((&t.vertical[..], &t.horizontal[..]), (&[0.0, 45.0, 90.0][..], &[0.0, 90.0][..]));
            // Multiplier 2 times ballast factor 0.5 is 1.
            assert_eq!(t.candela, [100.0, 50.0, 10.0, 80.0, 40.0, 0.0].map(|c| c * factor), "{first}");
            assert_eq!(t.odd.len(), usize::from(first.ends_with("2002")), "{first}: {:?}", t.odd);
        }
    }

    #[test]
    fn absolute_photometry_has_no_lamp_lumens() {
        let t = table(&file("IESNA:LM-63-2002", 1.0).replace("2 800 2", "1 -1 1"));
        assert_eq!((t.lamp_lumens, t.candela[0]), (None, 50.0));
    }

    #[test]
    fn numbers_may_be_broken_over_lines_and_line_ends_of_any_kind() {
        let plain = table(&file("IESNA:LM-63-2002", 1.0));
        for end in ["\r\n", "\r"] {
            assert_eq!(table(&file("IESNA:LM-63-2002", 1.0).replace('\n', end)), plain);
        }
        let broken = file("IESNA:LM-63-2002", 1.0).replace("0 45 90\n0 90", "0\n 45\n90 0\n\n90");
        assert_eq!(table(&broken), plain);
    }

    #[test]
    fn a_tilt_table_is_read_from_here_or_from_its_file() {
        let rows = "1\n3\n0 45 90\n1 0.8 0.5\n";
        let here = file("IESNA91", 1.0).replace("TILT=NONE\n", &format!("TILT=INCLUDE\n{rows}"));
        let expected = [[0.0, 1.0], [45.0, 0.8], [90.0, 0.5]];
        assert_eq!(table(&here).tilt, expected);
        let there = file("IESNA91", 1.0).replace("TILT=NONE", "tilt = MH.TLT");
        let given = parse(there.as_bytes(), |name| {
            assert_eq!(name, "MH.TLT");
            Ok(rows.into())
        });
        assert_eq!(given.expect("a good file").tilt, expected);
        let missing = parse(there.as_bytes(), no_file).expect_err("no file");
        assert_eq!(missing, Fault { line: 3, what: "TILT=MH.TLT: MH.TLT is not there".into() });
    }

    #[test]
    fn each_fault_is_named_with_its_line() {
        let good = file("IESNA:LM-63-2002", 1.0);
        for (from, to, line, what) in [
            ("TILT=NONE", "", 9, "no line TILT="),
            ("TILT=NONE", "TILT=", 3, "names nothing"),
            ("80, 40 , 0", "80 40", 9, "the file ends where a candela value"),
            ("0 45 90", "0 forty 90", 6, "'forty' where a vertical angle should be is no number"),
            ("0 45 90", "0 NaN 90", 6, "'NaN'"),
            ("0 45 90", "0 90 45", 6, "the vertical angle 45 follows 90"),
            ("0 45 90\n0 90", "0 45 90\n0 900", 7, "beyond 360"),
            ("2 800 2 3 2 1", "2 800 2 3 2 4", 4, "photometric type 4"),
            ("2 800 2 3 2 1", "2 800 2 1 2 1", 4, "the number of vertical angles is 1"),
            ("2 800 2 3 2 1", "2 800 2 3.5 2 1", 4, "is 3.5"),
            ("2 800 2 3 2 1", "2 800 2 3 0 1", 4, "the number of horizontal angles is 0"),
            ("2 800 2 3 2 1", "2 800 2 1e300 2 1", 4, "1000000000"),
            ("2 800 2 3 2 1", "2 800 2 1000000 1000000 1", 4, "1000000 x 1000000 angles are more"),
            ("2 800 2 3 2 1", "2 800 2 1000000 1 1", 5, "announced, more than the rest of the file"),
            ("2 800 2 3 2 1", "2 800 -2 3 2 1", 4, "the candela multiplier is -2"),
            ("2 800 2 3 2 1", "2 800 1e300 3 2 1", 8, "no lamp's"),
            ("TILT=NONE\n", "TILT=INCLUDE\n4\n", 4, "geometry 4"),
            ("0.5 1 40", "0.5 1", 6, "the input watts"),
        ] {
            let bad = good.replacen(from, to, 1);
            if what == "the input watts" {
                // Numbers run on over lines: what is missing shows at the end.
                let found = parse(bad.as_bytes(), no_file).expect_err(what);
                assert!(found.line > line, "{found}");
                continue;
            }
            let found = parse(bad.as_bytes(), no_file).expect_err(what);
            assert!(found.line == line && found.what.contains(what), "{to}: {found}, expected line {line}: {what}");
        }
    }

    #[test]
    fn odd_values_are_said() {
        let t = table(&(file("IESNA:LM-63-2002", 1.0).replace("50 10", "-50 10") + "7 7"));
        assert_eq!((t.candela[1], t.odd.len()), (0.0, 2));
        assert!(t.odd[0].contains("1 candela values are below 0") && t.odd[1].contains("after the last"));
    }
}
