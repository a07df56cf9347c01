//! From tickets to committed episodes: orders go out, whole episodes come back, in the order of the
//! orders.
//!
//! [`dispatcher`] keeps the books: which actor holds which ticket, what has arrived for it, and
//! what must be issued again. It is a state machine without clock or transport. [`assembly`] joins
//! the records of one episode; [`order`] describes what was ordered. [`server`] has the rounds of
//! the receiving thread, which feed the dispatcher from the [`ports`]; they have no clock either.
//! [`receiver`] is the thread around them, [`exchange`] what it and the training thread exchange.
//! [`situation`] says what is being waited for.

pub mod assembly;
pub mod dispatcher;
pub mod exchange;
mod failures;
pub mod order;
pub mod ports;
pub mod receiver;
pub mod server;
pub mod situation;

pub use exchange::{ReceiverError, ReceiverState};
