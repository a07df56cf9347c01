//! The Python package `skein-rl`: what Rust does of it. `skein_rl/` has the Python part.
//!
//! | module | content |
//! |---|---|
//! | [`task`] | what is flown: settings, courses, levels, encoder |
//! | [`environment`] | one environment: episodes from seeds, without Python |
//! | [`batch`] | what a call returns: one block of bytes, of which Python makes arrays |
//! | [`fleet`] | many environments, flown by several threads without the interpreter's lock |
//! | [`policy`] | a snapshot's encoder and policy, with the actor's own arithmetic |
//! | [`flight`] | whole episodes by the actor's own loop |
//! | [`values`] | Python's values as TOML's, and back |
//!
//! No thread outlives a call, so a process may fork between two. No panic is expected; PyO3 turns
//! one into an exception.

mod batch;
mod environment;
mod fleet;
mod flight;
mod parallel;
mod policy;
mod task;
mod values;

use pyo3::prelude::*;

/// Functions and classes behind `skein_rl`.
#[pymodule(name = "_core")]
fn core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<task::Task>()?;
    module.add_class::<fleet::Fleet>()?;
    module.add_class::<policy::Policy>()?;
    module.add_function(wrap_pyfunction!(task::read_config, module)?)?;
    module.add_function(wrap_pyfunction!(task::parse_toml, module)?)?;
    module.add_function(wrap_pyfunction!(flight::fly, module)?)?;
    module.add_function(wrap_pyfunction!(flight::simulate, module)?)?;
    module.add("REWARD_TERMS", skein_protocol::REWARD_TERM_NAMES.to_vec())?;
    module.add("COLUMNS", batch::names())?;
    module.add("MOST_MPS", environment::MOST_MPS)?;
    module.add("MOST_LATENT", environment::MOST_LATENT)?;
    module.add("SHIPPED_COURSES", task::shipped_names())?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))
}
