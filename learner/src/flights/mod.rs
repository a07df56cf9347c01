//! From tickets to committed flights: orders go out, whole flights come back, in the order they were ordered.
//!
//! [`desk`] is the book-keeping, a state machine without clock or transport: who holds which ticket, what has arrived of it, what must be issued again.
//! [`assembly`] puts the records of one flight together, [`order`] says what was ordered. [`reception`] is the thread that owns the transport and feeds the desk. [`faults`] counts what went
//! wrong and was made good, [`situation`] says who waits for whom.

pub mod assembly;
pub mod desk;
mod failures;
pub mod faults;
pub mod order;
pub mod reception;
mod server;
pub mod situation;
