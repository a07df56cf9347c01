//! Experiments: a question, the runs that answer it, and what they came to, with its uncertainty.
//!
//! An experiment is a file ([`definition`]): a base configuration and *arms*, settings that differ
//! from it. Each arm is trained with several seeds ([`plan`]), every one an ordinary run of `skein
//! run`, side by side, and may then fly an evaluation suite ([`runner`]); what another experiment
//! has trained already is taken over ([`sharing`]). What the runs left is read ([`results`]),
//! summed up over the seeds ([`statistics`]) and told ([`report`]). Nothing but the runs'
//! directories is kept from one call to the next, so that an experiment can be interrupted, gone on
//! with and reported again at any time.

pub mod board;
pub mod definition;
pub mod plan;
pub mod report;
pub mod results;
pub mod runner;
pub mod sharing;
pub mod statistics;
