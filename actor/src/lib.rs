//! Placeholder, replaced in the first build-up.
