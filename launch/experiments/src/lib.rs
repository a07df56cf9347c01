//! Experiments: a question, the runs that answer it, and a report of the results with their
//! uncertainty.
//!
//! An experiment is a file ([`definition`]): a base configuration and *arms*, which are settings
//! that differ from it. Each arm is trained with several seeds ([`plan`]). Every seed is an
//! ordinary run of `skein run`; runs share the machine, and may then fly an evaluation suite
//! ([`runner`]). Runs that another experiment has already trained are copied ([`sharing`]). The
//! runs' files are read ([`results`]), summarised over the seeds ([`statistics`]) and reported
//! ([`report`]). Only the runs' directories are kept between calls, so an experiment can be
//! interrupted, resumed and reported at any time.

pub mod board;
pub mod definition;
pub mod plan;
pub mod report;
pub mod results;
pub mod runner;
pub mod sharing;
pub mod statistics;
