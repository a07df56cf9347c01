//! Exit statuses and error messages of the programs.

use std::error::Error;
use std::io;
use std::iter::successors;

/// Exit status of a program whose arguments are wrong, as clap's.
pub const EXIT_WRONG_ARGUMENTS: u8 = 2;

/// Exit status of an actor that finds no learner, or has received no heartbeat for
/// `transport.learner_silence_secs`. Restarting it would not help.
pub const EXIT_LEARNER_GONE: u8 = 3;

/// Exit status of a learner whose transport failed. Its results are sound: it is restarted from its
/// newest checkpoint.
pub const EXIT_RESTART: u8 = 4;

/// Exit status of a learner or an actor that ran out of memory.
pub const EXIT_OUT_OF_MEMORY: u8 = 5;

/// Exit status of a program that its user interrupted, as shells report it: 128 + SIGINT.
pub const EXIT_INTERRUPTED: u8 = 130;

/// Returns the error with those of its causes that it does not quote itself, on one line. A file
/// beyond the process's limit gets its remedy here, whoever wrote it.
pub fn with_causes(error: &(dyn Error + 'static)) -> String {
    let causes = || successors(Some(error), |&error| error.source());
    let text = causes()
        .map(ToString::to_string)
        .fold(String::new(), |text, cause| match text.as_str() {
            "" => cause,
            message if message.contains(&cause) => text,
            message => format!("{message}: {cause}"),
        });
    let too_large = causes()
        .filter_map(|cause| cause.downcast_ref::<io::Error>())
        .any(|cause| cause.kind() == io::ErrorKind::FileTooLarge);
    match too_large {
        true => format!("{text}: the shell limits the size of files; raise it with ulimit -f"),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{text}")]
    struct Outer {
        text: &'static str,
        #[source]
        cause: std::fmt::Error,
    }

    #[test]
    fn each_cause_is_printed_once() {
        let cause = std::fmt::Error;
        let message = cause.to_string();
        let silent = Outer {
            text: "cannot write",
            cause,
        };
        assert_eq!(with_causes(&silent), format!("cannot write: {message}"));
        let text: &'static str = format!("cannot write: {message}").leak();
        assert_eq!(with_causes(&Outer { text, cause }), text);
    }

    #[test]
    fn a_file_beyond_the_limit_has_its_remedy() {
        let large = io::Error::from(io::ErrorKind::FileTooLarge);
        assert!(with_causes(&large).contains("ulimit -f"));
        let full = io::Error::from(io::ErrorKind::StorageFull);
        assert!(!with_causes(&full).contains("ulimit"));
    }
}
