//! Whole-system tests: what only holds, or fails, between the packages. They lie in `tests/`, one file a subject.
