//! Runtime and signal handling shared by the programs that supervise processes.

use std::io;

use skein_run::signals::is_ignored;
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// Returns a single-threaded runtime. Children are bound to the thread that started them, so all of
/// them must start on the main thread.
///
/// # Errors
/// Returns the operating system's error.
pub fn runtime() -> io::Result<Runtime> {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
}

/// Returns a channel with one message per request (by the user or the system) to end this process.
/// A signal that was ignored when it started, as SIGHUP is under `nohup`, stays ignored.
///
/// Must be called within a [`runtime`].
///
/// # Errors
/// Returns the operating system's error.
pub fn interrupts() -> io::Result<mpsc::Receiver<()>> {
    let (sender, receiver) = mpsc::channel(4);
    for kind in [
        SignalKind::interrupt(),
        SignalKind::terminate(),
        SignalKind::hangup(),
    ] {
        if is_ignored(kind.as_raw_value()) {
            continue;
        }
        let mut signal = signal(kind)?;
        let sender = sender.clone();
        tokio::spawn(async move {
            while signal.recv().await.is_some() {
                // Four requests are waiting already: a fifth adds nothing.
                let _ = sender.try_send(());
            }
        });
    }
    Ok(receiver)
}
