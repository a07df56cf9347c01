//! Text from outside the process.

use std::fs;
use std::io;
use std::ops::RangeInclusive;
use std::path::Path;

use serde::de::{DeserializeOwned, Error};
use serde::{Deserialize, Deserializer};

/// Most bytes of a file: far more than any course or suite needs.
const MOST_BYTES: u64 = 1 << 20;

/// Reads a text file.
///
/// # Errors
/// As [`read_file`], or if it is not UTF-8.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    let bytes = read_file(path, MOST_BYTES)?;
    String::from_utf8(bytes).map_err(|_| {
        io::Error::new(
            io::ErrorKind::InvalidData,
            "stream did not contain valid UTF-8",
        )
    })
}

/// Reads a file.
///
/// # Errors
/// If the file cannot be read, exceeds `most_bytes`, or is not a regular file: reading a pipe or a
/// device might never end.
pub(crate) fn read_file(path: &Path, most_bytes: u64) -> io::Result<Vec<u8>> {
    let about = fs::metadata(path)?;
    if about.is_dir() {
        return Err(io::Error::other("it is a folder: name a file"));
    }
    if !about.is_file() || about.len() > most_bytes {
        return Err(io::Error::other(format!(
            "not a regular file of at most {most_bytes} bytes"
        )));
    }
    fs::read(path)
}

/// Parses TOML of which every part is used.
///
/// # Errors
/// The parser's error. A list that is too long for the table it stands for is refused too; the
/// parser alone ignores its end.
pub(crate) fn parse_whole<T: DeserializeOwned>(text: &str) -> Result<T, toml::de::Error> {
    let parsed = toml::from_str(text)?;
    let table: toml::Table = toml::from_str(text)?;
    table.try_into::<T>()?;
    Ok(parsed)
}

/// Returns the parser's error on `text` on one line, with the key if the error has no place in the
/// text.
pub(crate) fn message_of(text: &str, error: &toml::de::Error) -> String {
    if let Some(message) = integer_too_large(text, error) {
        return message;
    }
    let text = match error.span() {
        Some(_) => error.message().to_owned(),
        None => error.to_string(),
    };
    text.trim_end().replace('\n', " ")
}

/// Returns key, value and remedy if `error` is an integer that TOML does not hold: the parser knows
/// only the type.
fn integer_too_large(text: &str, error: &toml::de::Error) -> Option<String> {
    let place = error.span()?;
    let value = text.get(place.clone()).filter(|value| is_integer(value))?;
    // One that TOML holds was refused for another reason.
    if toml::from_str::<toml::Table>(&format!("value = {value}")).is_ok() {
        return None;
    }
    Some(format!(
        "`{}` = {value} is outside {} to {}: choose an integer within",
        key_before(text, place.start),
        i64::MIN,
        i64::MAX
    ))
}

/// `true` for an integer in TOML's notation, of any size.
fn is_integer(text: &str) -> bool {
    let unsigned = text.strip_prefix(['+', '-']).unwrap_or(text);
    let (digits, radix) = match unsigned.get(..2) {
        Some("0x") => (&unsigned[2..], 16),
        Some("0o") => (&unsigned[2..], 8),
        Some("0b") => (&unsigned[2..], 2),
        _ => (unsigned, 10),
    };
    digits.starts_with(|first: char| first.is_digit(radix))
        && digits
            .chars()
            .all(|digit| digit.is_digit(radix) || digit == '_')
}

/// Returns the key whose value begins at byte `start` of the TOML `text`.
fn key_before(text: &str, start: usize) -> &str {
    let before = text.get(..start).unwrap_or_default();
    let key = before
        .rsplit_once('=')
        .map_or("", |(key, _)| key.trim_end());
    let ends = |sign: char| sign.is_whitespace() || ",{".contains(sign);
    key.rsplit(ends).next().unwrap_or_default()
}

/// Returns `true` if `name` can be shown on a terminal and in a table: it is one line, without
/// control characters, signs that turn the direction of writing round, and `|`.
pub fn fits_in_a_table(name: &str) -> bool {
    const TURNS: [RangeInclusive<char>; 3] = [
        '\u{200e}'..='\u{200f}',
        '\u{202a}'..='\u{202e}',
        '\u{2066}'..='\u{2069}',
    ];
    let turns = |sign| TURNS.iter().any(|turn| turn.contains(&sign));
    !name.contains(|sign: char| sign.is_control() || turns(sign) || sign == '|')
}

/// Returns the first of `items` that an earlier one equals.
pub fn first_repeated<T: PartialEq>(items: &[T]) -> Option<&T> {
    (1..items.len())
        .find(|&index| items[..index].contains(&items[index]))
        .map(|index| &items[index])
}

/// Deserializes exactly `N` numbers. The parser alone ignores further ones.
pub(crate) fn exactly<'de, D: Deserializer<'de>, T: Deserialize<'de>, const N: usize>(
    deserializer: D,
) -> Result<[T; N], D::Error> {
    let numbers = Vec::<T>::deserialize(deserializer)?;
    numbers.try_into().map_err(|numbers: Vec<T>| {
        D::Error::custom(format!(
            "has {} numbers: give {N} (a decimal point is a dot)",
            numbers.len()
        ))
    })
}
