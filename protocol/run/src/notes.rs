//! Standard error that holds nothing up.
//!
//! A terminal stopped by Ctrl-S, or a reader that reads no more, lets a write wait for ever. Where
//! a program must not wait, a thread of its own writes, and text that finds it busy is lost.

use std::io::{self, Write};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

/// Texts that wait to be written: more than one screen.
const MOST_WAITING: usize = 64;
/// Time for a terminal to take what waits when the program ends.
const SETTLED_WITHIN: Duration = Duration::from_secs(1);
/// Time between two attempts to settle.
const PAUSE: Duration = Duration::from_millis(5);

static QUEUE: OnceLock<SyncSender<Message>> = OnceLock::new();

enum Message {
    Text(String),
    /// Answered when all before it is written.
    Settle(SyncSender<()>),
}

/// Lets this process write to standard error by a thread of its own from now on. If the system
/// starts no thread, writes wait as before.
pub fn never_wait() {
    let (sender, receiver) = sync_channel(MOST_WAITING);
    let thread = thread::Builder::new().name("notes".to_owned());
    if thread.spawn(|| write_all(receiver, io::stderr())).is_ok() {
        // A second call ends its own thread here, by its sender.
        let _ = QUEUE.set(sender);
    }
}

/// Writes `text` to standard error, or loses it.
pub fn write(text: String) {
    match QUEUE.get() {
        Some(queue) => offer(queue, text),
        None => {
            let mut stream = io::stderr().lock();
            let _ = stream.write_all(text.as_bytes());
            let _ = stream.flush();
        }
    }
}

/// Waits until what was written before is on standard error, for a second at most. Once that did
/// not help, no later call waits.
pub fn settle() {
    static GAVE_UP: AtomicBool = AtomicBool::new(false);
    if let Some(queue) = QUEUE.get()
        && !GAVE_UP.load(Ordering::Relaxed)
    {
        let settled = settle_within(queue, SETTLED_WITHIN);
        GAVE_UP.store(!settled, Ordering::Relaxed);
    }
}

/// Loses `text` if the queue is full.
fn offer(queue: &SyncSender<Message>, text: String) {
    drop(queue.try_send(Message::Text(text)));
}

/// Returns `true` if all that was written before is written.
fn settle_within(queue: &SyncSender<Message>, limit: Duration) -> bool {
    let deadline = Instant::now() + limit;
    let (answer, answered) = sync_channel(1);
    while let Err(TrySendError::Full(_)) = queue.try_send(Message::Settle(answer.clone())) {
        if Instant::now() >= deadline {
            return false;
        }
        thread::sleep(PAUSE);
    }
    let left = deadline.saturating_duration_since(Instant::now());
    answered.recv_timeout(left).is_ok()
}

fn write_all(messages: Receiver<Message>, mut output: impl Write) {
    for message in messages {
        match message {
            Message::Text(text) => {
                let _ = output.write_all(text.as_bytes());
                let _ = output.flush();
            }
            Message::Settle(answer) => drop(answer.try_send(())),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn a_reader_that_stops_holds_nothing_up_and_text_is_whole_or_lost() {
        let (mut reader, writer) = io::pipe().unwrap();
        let (queue, receiver) = sync_channel(MOST_WAITING);
        let thread = thread::spawn(|| write_all(receiver, writer));
        // A full queue has far more text than a pipe holds, whenever the thread begins.
        let line = |number: usize| format!("{number:>8191}\n");
        let begun = Instant::now();
        for number in 0..2000 {
            offer(&queue, line(number));
        }
        assert!(!settle_within(&queue, Duration::from_millis(50)));
        assert!(begun.elapsed() < Duration::from_secs(5));
        drop(queue);
        let mut read = String::new();
        reader.read_to_string(&mut read).unwrap();
        thread.join().unwrap();
        let numbers: Vec<usize> = read
            .lines()
            .map(|line| line.trim().parse().unwrap())
            .collect();
        assert!(
            (MOST_WAITING..2000).contains(&numbers.len()),
            "{}",
            numbers.len()
        );
        assert!(numbers.is_sorted() && numbers[0] == 0);
    }

    #[test]
    fn settling_waits_for_what_was_written_before() {
        let (mut reader, writer) = io::pipe().unwrap();
        let (queue, receiver) = sync_channel(MOST_WAITING);
        thread::spawn(|| write_all(receiver, writer));
        queue.send(Message::Text("text".to_owned())).unwrap();
        assert!(settle_within(&queue, Duration::from_secs(20)));
        let mut text = [0; 4];
        reader.read_exact(&mut text).unwrap();
        assert_eq!(&text, b"text");
    }
}
