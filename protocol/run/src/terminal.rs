//! Output for the user. It is best effort: a terminal that was closed, a pipe without a reader or a
//! full disk loses the text and changes nothing else.
//!
//! Programs print with [`show!`](crate::show) and [`note!`](crate::note), because the standard
//! library's macros panic when a write fails.

use std::ffi::OsString;
use std::fmt::Arguments;
use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;
use std::path::Path;

use crate::notes;

/// Width of a terminal that does not report one.
const USUAL_COLUMNS: usize = 80;

/// Prints a line to standard output, as `println!` does, after all notes. A failed write is
/// ignored.
#[macro_export]
macro_rules! show {
    ($($part:tt)*) => {
        $crate::terminal::show_line(::std::format_args!($($part)*))
    };
}

/// Prints a line to standard error, as `eprintln!` does. A failed write is ignored.
#[macro_export]
macro_rules! note {
    ($($part:tt)*) => {
        $crate::notes::write(::std::format!("{}\n", ::std::format_args!($($part)*)))
    };
}

/// Writes `text` and a line break to standard output; ignores a failure.
pub fn show_line(text: Arguments<'_>) {
    notes::settle();
    write_line(io::stdout().lock(), text);
}

/// Writes `text` and a line break to `output` at once; ignores a failure.
fn write_line(mut output: impl Write, text: Arguments<'_>) {
    let _ = output.write_all(format!("{text}\n").as_bytes());
    let _ = output.flush();
}

/// Writer that ignores failures, for output that nothing else may depend on.
#[derive(Debug)]
pub struct BestEffort<W>(pub W);

impl<W: Write> Write for BestEffort<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let _ = self.0.write_all(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let _ = self.0.flush();
        Ok(())
    }
}

/// Returns the columns available on standard output; see [`stderr_columns`].
pub fn stdout_columns() -> usize {
    columns_of(&io::stdout())
}

/// Returns the columns available on standard error: the environment variable `COLUMNS` if it is a
/// number, else the terminal's width. Anything but a terminal has no limit: a file does not wrap.
pub fn stderr_columns() -> usize {
    columns_of(&io::stderr())
}

fn columns_of(stream: &(impl AsFd + IsTerminal)) -> usize {
    let reported = || match rustix::termios::tcgetwinsize(stream) {
        Ok(size) if size.ws_col > 0 => size.ws_col.into(),
        _ => USUAL_COLUMNS,
    };
    columns(
        std::env::var("COLUMNS").ok().as_deref(),
        stream.is_terminal().then(reported),
    )
}

/// Returns the columns by the variable `COLUMNS` and the `terminal`'s own width.
fn columns(wanted: Option<&str>, terminal: Option<usize>) -> usize {
    wanted
        .and_then(|text| text.parse().ok())
        .filter(|&columns| columns > 0)
        .or(terminal)
        .unwrap_or(usize::MAX)
}

/// Returns `true` if standard error is a terminal on which a line can be redrawn.
pub fn can_redraw() -> bool {
    let stream = match io::stderr().is_terminal() {
        true => Stream::Terminal(std::env::var_os("TERM")),
        false => Stream::Other,
    };
    stream.can_redraw()
}

/// Destination of output.
enum Stream {
    /// A terminal, with its `TERM`.
    Terminal(Option<OsString>),
    Other,
}

impl Stream {
    fn can_redraw(&self) -> bool {
        match self {
            Self::Terminal(name) => name.as_ref().is_none_or(|name| name != "dumb"),
            Self::Other => false,
        }
    }
}

/// Returns `text` cut to `columns`, with "…" as its end where something is missing.
pub fn cut(text: &str, columns: usize) -> String {
    if text.chars().count() <= columns {
        return text.to_owned();
    }
    let kept = text.chars().take(columns.saturating_sub(1));
    kept.chain("…".chars().take(columns)).collect()
}

/// Returns `text` broken into lines of at most `columns`, at the separators ` · ` between figures.
/// A terminal would break it anywhere, and a progress bar would not know how many lines to redraw.
/// A longer figure is cut.
pub fn wrapped(text: &str, columns: usize) -> String {
    let mut lines: Vec<String> = Vec::new();
    for figure in text.split(" · ") {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 3 + figure.chars().count() <= columns => {
                line.push_str(" · ");
                line.push_str(figure);
            }
            _ => lines.push(cut(figure, columns)),
        }
    }
    lines.join("\n")
}

/// Returns `path` as a word of a shell command that the user can paste.
pub fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let is_plain = |character: char| character.is_alphanumeric() || "/._-+=:,@".contains(character);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => text,
        false => format!("'{}'", text.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::OpenOptions;

    use super::*;

    #[test]
    fn a_full_device_loses_the_text_and_nothing_else() {
        let full = || OpenOptions::new().write(true).open("/dev/full").unwrap();
        assert!(full().write_all(b"text").is_err());
        write_line(full(), format_args!("text"));
        BestEffort(full()).write_all(b"text").unwrap();
        BestEffort(full()).flush().unwrap();
    }

    #[test]
    fn a_pipe_without_a_reader_loses_the_text_and_nothing_else() {
        let (reader, writer) = io::pipe().unwrap();
        drop(reader);
        write_line(writer, format_args!("text"));
    }

    #[test]
    fn columns_are_those_asked_for_then_the_terminals_and_unlimited_in_a_file() {
        assert_eq!(columns(Some("100"), Some(80)), 100);
        for unusable in [None, Some(""), Some("0"), Some("wide")] {
            assert_eq!(columns(unusable, Some(132)), 132);
            assert_eq!(columns(unusable, None), usize::MAX);
        }
    }

    #[test]
    fn only_a_terminal_that_is_not_dumb_is_redrawn() {
        let terminal = |name: Option<&str>| Stream::Terminal(name.map(OsString::from));
        assert!(terminal(Some("xterm-256color")).can_redraw());
        assert!(terminal(None).can_redraw());
        assert!(!terminal(Some("dumb")).can_redraw());
        assert!(!Stream::Other.can_redraw());
    }

    #[test]
    fn a_text_is_cut_at_characters() {
        assert_eq!(cut("ärger", 5), "ärger");
        assert_eq!(cut("ärger", 3), "är…");
        assert_eq!(cut("ärger", 0), "");
    }

    #[test]
    fn no_wrapped_line_exceeds_the_columns() {
        let text = "episode 512/2000 · 1:02:05, 1:01 left · walls passed 1.23";
        for columns in 1..80 {
            let lines = wrapped(text, columns);
            let longest = lines.lines().map(|line| line.chars().count()).max();
            assert!(longest.unwrap() <= columns, "{columns}: {lines}");
        }
        assert_eq!(wrapped(text, text.chars().count()), text);
    }

    #[test]
    fn paths_in_commands_are_quoted_where_a_shell_needs_it() {
        let shown = |path: &str| quoted(Path::new(path));
        assert_eq!(shown("/tmp/run-1.5"), "/tmp/run-1.5");
        assert_eq!(shown("/tmp/my runs"), "'/tmp/my runs'");
        assert_eq!(shown("/tmp/it's"), r"'/tmp/it'\''s'");
        assert_eq!(shown("$HOME"), "'$HOME'");
        assert_eq!(shown(""), "''");
    }
}
