//! Says where in a course file the parser stumbled: line, wall and key.
//!
//! The parser knows a byte, its user thinks in walls. Lines are looked at, not tables: a file that
//! is no TOML still has walls and keys.

use std::ops::Range;

use super::{Place, WallLabel};

/// Where in a course file something is wrong.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Whereabouts {
    /// The line, from 1.
    pub(super) line: usize,
    /// The wall in whose table the line stands, if its label can be read.
    pub(super) place: Place,
    /// The key whose value the line is part of, or the name of the table that begins there.
    pub(super) key: Option<String>,
}

impl Whereabouts {
    /// Those of the bytes `span` of `text`.
    pub(super) fn of(span: Range<usize>, text: &str) -> Self {
        // What the whole file lacks is reported at its first byte, whatever stands there.
        let whole_file = span == (0..0);
        let line = 1 + text
            .bytes()
            .take(span.start)
            .filter(|byte| *byte == b'\n')
            .count();
        let (mut table, mut label, mut key) = ("", None, None);
        for (number, text) in (1..).zip(text.lines().map(str::trim_start)) {
            if let Some(header) = header(text) {
                if number > line {
                    break;
                }
                (table, label, key) = (header, None, (header != "wall").then_some(header));
                continue;
            }
            // Any other line is a comment or goes on with the value of the key before it.
            let Some(name) = bare_key(text) else { continue };
            if number <= line {
                key = Some(name);
            }
            if table == "wall" && name == "label" {
                label = integer_after(name, text);
            }
        }
        Self {
            line,
            place: label.map_or(Place::Course, |label| Place::Wall(WallLabel(label))),
            key: key.filter(|_| !whole_file).map(str::to_owned),
        }
    }
}

/// The name in `[name]` or `[[name]]`, closed or not; the rows of an array are none.
fn header(line: &str) -> Option<&str> {
    line.starts_with('[')
        .then(|| bare_key(line.trim_start_matches(['[', ' '])))?
}

/// The word that a line begins with; numbers are none.
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
    fn assert_found(fault: &str, line: usize, place: Place, key: Option<&str>) {
        let start = TEXT.find(fault).unwrap();
        let found = Whereabouts::of(start..start + fault.len(), TEXT);
        let key = key.map(str::to_owned);
        assert_eq!(found, Whereabouts { line, place, key }, "{fault}");
    }

    #[test]
    fn a_value_over_several_lines_belongs_to_its_key() {
        assert_found("2O.0", 4, Place::Course, Some("wall_x_m"));
        assert_found("\"x\"", 10, Place::Wall(WallLabel(4)), Some("points_m"));
    }

    #[test]
    fn walls_are_known_by_labels_before_and_after_the_fault() {
        assert_found(
            "0.0\npoints",
            7,
            Place::Wall(WallLabel(4)),
            Some("centre_m"),
        );
        assert_found("seven", 14, Place::Course, Some("label"));
        assert_found("[[wall\n", 15, Place::Wall(WallLabel(8)), None);
    }

    #[test]
    fn what_follows_a_wall_is_not_part_of_it() {
        assert_found("\"long\"", 18, Place::Course, Some("length_m"));
        assert_found("[corridor]", 17, Place::Course, Some("corridor"));
    }

    #[test]
    fn what_the_whole_file_lacks_has_no_key() {
        let found = Whereabouts::of(0..0, TEXT);
        assert_eq!((found.place, found.key), (Place::Course, None));
    }

    #[test]
    fn the_end_of_the_file_is_somewhere() {
        let found = Whereabouts::of(TEXT.len()..TEXT.len(), TEXT);
        assert_eq!((found.line, found.place), (19, Place::Course));
        assert_eq!(Whereabouts::of(0..0, "").line, 1);
    }
}
