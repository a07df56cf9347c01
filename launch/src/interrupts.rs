//! How a program of ours waits for its processes and for its user's Ctrl-C.

use std::io;

use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// All on the main thread: children are bound to the incarnation of the thread that started them.
///
/// # Errors
/// When the system refuses.
pub fn runtime() -> io::Result<Runtime> {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
}

/// One message for each time the user, or the system, asks this process to end. Within a
/// [`runtime`].
///
/// # Errors
/// When the system refuses.
pub fn interrupts() -> io::Result<mpsc::Receiver<()>> {
    let (sender, receiver) = mpsc::channel(4);
    for kind in [
        SignalKind::interrupt(),
        SignalKind::terminate(),
        SignalKind::hangup(),
    ] {
        let mut signal = signal(kind)?;
        let sender = sender.clone();
        tokio::spawn(async move {
            while signal.recv().await.is_some() {
                // When four are waiting, a fifth says nothing new.
                let _ = sender.try_send(());
            }
        });
    }
    Ok(receiver)
}
