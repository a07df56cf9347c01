//! How much shared memory the services take, and that it is there before it is used.
//!
//! A segment is as long as its contents may become, but the system gives it memory page by page, as
//! it is touched. If there is none left then, whoever touches it dies of SIGBUS. So whoever has
//! opened its ends of the services reserves what they may need.

use std::fs::{self, OpenOptions};
use std::io;

use rustix::fs::FallocateFlags;
use rustix::mm::{Advice, madvise};

use super::learner::SNAPSHOT_SLOTS;
use super::opening::{control_buffer, control_slots, segment_slots, transition_buffer};
use super::{ServiceError, failed};
use skein_protocol::config::Config;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::SnapshotLayout;
use skein_protocol::ticket::ControlRecord;
use skein_protocol::transition::TransitionRecord;
use skein_run::{LearnerIncarnation, RunIdentity};

/// iceoryx2's header of a sample and what aligns it, generously.
const SAMPLE_OVERHEAD: usize = 128;
/// Queues and book-keeping of an actor's ends, besides what depends on the configuration.
const ACTOR_OVERHEAD: usize = 96 << 10;
/// Queues and book-keeping of the learner's ends, likewise.
const LEARNER_OVERHEAD: usize = 256 << 10;
/// Book-keeping for an actor that there may be.
const SLOT_OVERHEAD: usize = 3 << 10;

/// Bytes of shared memory that a learner and `actors` actors with `config` take.
pub fn shared_memory_needed(config: &Config, actors: usize) -> u64 {
    let snapshot = SnapshotLayout::of(config).values() * size_of::<f32>() + SAMPLE_OVERHEAD;
    let control =
        control_slots(&config.transport) * (size_of::<ControlRecord>() + SAMPLE_OVERHEAD / 2);
    let segments =
        segment_slots(&config.transport) * (size_of::<SegmentRecord>() + SAMPLE_OVERHEAD / 2);
    let slots = config.transport.max_actors * SLOT_OVERHEAD;
    let learner = SNAPSHOT_SLOTS * snapshot + control + segments + slots + LEARNER_OVERHEAD;
    // Episodes of all tickets, and what either side has in hand.
    let records = transition_buffer(&config.transport) + 8;
    // A queue of eight bytes a message there and back, and one byte to say who has it.
    let queues = 2 * 8 * control_buffer(&config.transport) + control_slots(&config.transport);
    let actor =
        records * (size_of::<TransitionRecord>() + SAMPLE_OVERHEAD) + queues + ACTOR_OVERHEAD;
    (learner + actors * actor) as u64
}

/// Reserves the memory of all segments of `incarnation`.
///
/// # Errors
/// [`ServiceError`] when there is not enough.
pub(super) fn reserve(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
) -> Result<(), ServiceError> {
    for segment in identity.shared_memory(incarnation) {
        match reserve_segment(&segment) {
            // Its owner has removed it meanwhile.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            reserved => reserved.map_err(failed("all", "reserving shared memory"))?,
        }
    }
    Ok(())
}

/// Takes the whole pages of `shared`, which lies in a segment, out of this process's memory; they
/// stay in the segment, and come back when they are read. An actor looks at each snapshot once: if
/// it kept what it has looked at, all of the learner's segment would count as its own.
pub(super) fn let_go(shared: &[u8]) {
    let page = rustix::param::page_size();
    let skipped = shared.as_ptr().align_offset(page);
    let Some(pages) = shared.get(skipped..) else {
        return;
    };
    let whole = pages.len() / page * page;
    if whole == 0 {
        return;
    }
    // SAFETY: these pages lie within `shared`. They are mapped from a file and shared, so the file
    // keeps what is written on them, and whoever reads them again is given the same bytes.
    let let_go = unsafe {
        madvise(
            pages.as_ptr().cast_mut().cast(),
            whole,
            Advice::LinuxDontNeed,
        )
    };
    if let Err(error) = let_go {
        tracing::debug!(%error, "pages of a snapshot are kept");
    }
}

fn reserve_segment(segment: &std::path::Path) -> io::Result<()> {
    use std::os::unix::fs::MetadataExt;
    /// Bytes in which the system counts what a file takes.
    const BLOCK: u64 = 512;
    let about = fs::metadata(segment)?;
    if about.len() <= about.blocks() * BLOCK {
        return Ok(());
    }
    let file = OpenOptions::new().write(true).open(segment)?;
    Ok(rustix::fs::fallocate(
        &file,
        FallocateFlags::empty(),
        0,
        about.len(),
    )?)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::MetadataExt;

    use super::super::tests::Run;
    use super::super::{ActorPorts, LearnerPorts};
    use super::*;

    /// Bytes of shared memory that this process has in its own, of the mapping that `address` lies
    /// in.
    fn resident(address: *const u8) -> usize {
        let maps = fs::read_to_string("/proc/self/smaps").unwrap();
        let number = |text: &str| usize::from_str_radix(text, 16).ok();
        let mut is_it = false;
        for line in maps.lines() {
            let first = line.split_whitespace().next().unwrap();
            if let Some((start, end)) = first.split_once('-')
                && let (Some(start), Some(end)) = (number(start), number(end))
            {
                is_it = (start..end).contains(&(address as usize));
            } else if is_it && first == "Rss:" {
                return line
                    .split_whitespace()
                    .nth(1)
                    .unwrap()
                    .parse::<usize>()
                    .unwrap()
                    << 10;
            }
        }
        panic!("{address:?} is not mapped");
    }

    #[test]
    fn what_is_let_go_is_out_of_this_process_and_comes_back_unchanged() {
        let mut file = tempfile::tempfile_in("/dev/shm").unwrap();
        let written: Vec<u8> = (0..1 << 20).map(|index| (index % 251) as u8).collect();
        std::io::Write::write_all(&mut file, &written).unwrap();
        // SAFETY: a new mapping of a file that nobody else has.
        let mapped = unsafe {
            rustix::mm::mmap(
                std::ptr::null_mut(),
                written.len(),
                rustix::mm::ProtFlags::READ,
                rustix::mm::MapFlags::SHARED,
                &file,
                0,
            )
        };
        let start = mapped.unwrap().cast::<u8>();
        // SAFETY: all of the mapping, which is never unmapped.
        let shared = unsafe { std::slice::from_raw_parts(start.cast_const(), written.len()) };
        assert_eq!(shared, written);
        let before = resident(start);
        // Not on a page's boundary: what shares a page with others is not let go.
        let_go(&shared[100..written.len() - 100]);
        let after = resident(start);
        assert!(
            before >= written.len() && after <= 3 * rustix::param::page_size(),
            "{before} {after}"
        );
        let_go(&shared[10..20]);
        assert_eq!(shared, written);
    }

    #[test]
    fn what_is_needed_is_what_is_taken_and_a_little_more() {
        for (max_actors, width) in [(2, 8), (64, 256), (256, 8)] {
            let run = Run::with(|config| {
                config.transport.max_actors = max_actors;
                config.sac.hidden_width = width;
            });
            let learner =
                LearnerPorts::open(&run.identity, run.lock.incarnation(), &run.config).unwrap();
            let taken = || -> u64 {
                let segments = run.identity.shared_memory(run.lock.incarnation());
                segments
                    .map(|path| fs::metadata(path).unwrap().blocks() * 512)
                    .sum()
            };
            let mut actors = Vec::new();
            for joined in 0..=2 {
                let needed = shared_memory_needed(&run.config, joined);
                let (least, most) = (needed * 80 / 100, needed);
                let taken = taken();
                assert!(
                    (least..=most).contains(&taken),
                    "{joined} of {max_actors} actors take {taken} bytes where {needed} are foreseen"
                );
                actors.push(ActorPorts::join(&run.identity, &run.config).unwrap());
                learner.maintain().unwrap();
            }
        }
    }
}
