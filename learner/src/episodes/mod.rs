//! From tickets to committed episodes: orders go out, whole episodes come back, in the order they
//! were ordered.
//!
//! [`dispatcher`] is the book-keeping, a state machine without clock or transport: who holds which
//! ticket, what has arrived of it, what must be issued again. [`assembly`] puts the records of one
//! episode together, [`order`] says what was ordered. [`receiver`] is the thread that owns the
//! transport and feeds the dispatcher. [`faults`] counts what went wrong and was made good,
//! [`situation`] says who waits for whom.

pub mod assembly;
pub mod dispatcher;
mod failures;
pub mod faults;
pub mod order;
pub mod receiver;
mod server;
pub mod situation;
