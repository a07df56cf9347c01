//! Text files from outside the process.

use std::fs;
use std::io;
use std::path::Path;

use serde::de::{DeserializeOwned, Error};
use serde::{Deserialize, Deserializer};

/// Most bytes of a file: far more than any course or suite needs.
const MOST_BYTES: u64 = 1 << 20;

/// Reads a text file.
///
/// # Errors
/// If the file cannot be read, exceeds [`MOST_BYTES`], or is not a regular file: reading a pipe or
/// a device might never end.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    let about = fs::metadata(path)?;
    if !about.is_file() || about.len() > MOST_BYTES {
        return Err(io::Error::other(format!(
            "not a regular file of at most {MOST_BYTES} bytes"
        )));
    }
    fs::read_to_string(path)
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

/// Returns the parser's error on one line, with the key if the error has no place in the text.
pub(crate) fn message_of(error: &toml::de::Error) -> String {
    let text = match error.span() {
        Some(_) => error.message().to_owned(),
        None => error.to_string(),
    };
    text.trim_end().replace('\n', " ")
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
