//! Durations as reports and progress lines show them.

use std::fmt;

/// A duration as `m:ss` or `h:mm:ss`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clock(
    /// Seconds.
    pub f64,
);

impl fmt::Display for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let secs = self.0.max(0.0).round() as u64;
        let (hours, minutes, secs) = (secs / 3600, secs / 60 % 60, secs % 60);
        match hours {
            0 => write!(f, "{minutes}:{secs:02}"),
            _ => write!(f, "{hours}:{minutes:02}:{secs:02}"),
        }
    }
}
