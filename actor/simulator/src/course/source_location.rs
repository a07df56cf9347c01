//! Location of a parser error in a course file: line, wall or obstacle, and key.
//!
//! The parser reports a byte, but a user thinks in walls and obstacles. The search goes by lines
//! instead of parsed tables, because a file that is not TOML still has walls and keys.

use std::ops::Range;

use super::{FaultLocation, WallLabel};

/// Location of an error in a course file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SourceLocation {
    /// The line, from 1.
    pub(super) line: usize,
    /// The wall whose table holds the line, if its label can be read, or the obstacle.
    pub(super) location: FaultLocation,
    /// The key whose value holds the line, or the name of the table that begins there.
    pub(super) key: Option<String>,
}

impl SourceLocation {
    /// Returns the location of the bytes `span` of `text`.
    pub(super) fn of(span: Range<usize>, text: &str) -> Self {
        // The parser reports a key that the whole file lacks at the first byte.
        let whole_file = span == (0..0);
        let line = 1 + text
            .bytes()
            .take(span.start)
            .filter(|byte| *byte == b'\n')
            .count();
        let (mut table, mut label, mut key) = ("", None, None);
        let mut obstacles = 0;
        for (number, text) in (1..).zip(text.lines().map(str::trim_start)) {
            if let Some(header) = header(text) {
                if number > line {
                    break;
                }
                let is_item = ["wall", "obstacle"].contains(&header);
                (table, label, key) = (header, None, (!is_item).then_some(header));
                obstacles += usize::from(header == "obstacle");
                continue;
            }
            // Any other line is a comment or continues the value of the previous key.
            let Some(name) = bare_key(text) else { continue };
            if number <= line {
                key = Some(name);
            }
            if table == "wall" && name == "label" {
                label = integer_after(name, text);
            }
        }
        let location = match (table, label) {
            // `[[obstacle.opening]]` belongs to the obstacle before it.
            _ if table.split('.').next() == Some("obstacle") => FaultLocation::Obstacle(obstacles),
            (_, Some(label)) => FaultLocation::Wall(WallLabel(label)),
            (_, None) => FaultLocation::Course,
        };
        Self {
            line,
            location,
            key: key.filter(|_| !whole_file).map(str::to_owned),
        }
    }
}

/// Returns the name in `[name]` or `[[name]]`, closed or not; `None` for the rows of an array.
fn header(line: &str) -> Option<&str> {
    line.starts_with('[')
        .then(|| bare_key(line.trim_start_matches(['[', ' '])))?
}

/// Returns the key that a line begins with; `None` if it begins with a number.
fn bare_key(line: &str) -> Option<&str> {
    let is_key = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    let key = line.split(|c| !is_key(c)).next()?;
    key.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
        .then_some(key)
}

fn integer_after(key: &str, line: &str) -> Option<u32> {
    let value = line.strip_prefix(key)?.trim_start().strip_prefix('=')?;
    value.split('#').next()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"order = [4, 7]
wall_x_m = [
    10.0,
    2O.0,
]
[[wall]] # the first
centre_m 0.0
points_m = [
    [-1.0, 0.0],
    [1.0, "x"],
]
label = 4 # after the fault
[[wall]]
label = seven
[[wall
label = 8
[corridor]
length_m = "long"
"#;

    #[track_caller]
    fn assert_found(fault: &str, line: usize, location: FaultLocation, key: Option<&str>) {
        let start = TEXT.find(fault).unwrap();
        let found = SourceLocation::of(start..start + fault.len(), TEXT);
        let key = key.map(str::to_owned);
        let expected = SourceLocation {
            line,
            location,
            key,
        };
        assert_eq!(found, expected, "{fault}");
    }

    #[test]
    fn a_value_over_several_lines_belongs_to_its_key() {
        assert_found("2O.0", 4, FaultLocation::Course, Some("wall_x_m"));
        assert_found(
            "\"x\"",
            10,
            FaultLocation::Wall(WallLabel(4)),
            Some("points_m"),
        );
    }

    #[test]
    fn walls_are_known_by_labels_before_and_after_the_fault() {
        assert_found(
            "0.0\npoints",
            7,
            FaultLocation::Wall(WallLabel(4)),
            Some("centre_m"),
        );
        assert_found("seven", 14, FaultLocation::Course, Some("label"));
        assert_found("[[wall\n", 15, FaultLocation::Wall(WallLabel(8)), None);
    }

    #[test]
    fn a_table_after_a_wall_is_not_part_of_it() {
        assert_found("\"long\"", 18, FaultLocation::Course, Some("length_m"));
        assert_found("[corridor]", 17, FaultLocation::Course, Some("corridor"));
    }

    #[test]
    fn a_key_missing_from_the_whole_file_has_no_line_key() {
        let found = SourceLocation::of(0..0, TEXT);
        assert_eq!((found.location, found.key), (FaultLocation::Course, None));
    }

    #[test]
    fn the_end_of_the_file_has_a_line() {
        let found = SourceLocation::of(TEXT.len()..TEXT.len(), TEXT);
        assert_eq!((found.line, found.location), (19, FaultLocation::Course));
        assert_eq!(SourceLocation::of(0..0, "").line, 1);
    }
}
