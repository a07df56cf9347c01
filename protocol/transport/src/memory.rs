//! The shared memory that the services need, and its reservation.
//!
//! A segment is as long as its contents may become, but the system assigns memory page by page, at
//! the first access. If none is left then, the process dies of SIGBUS. So every process reserves
//! the memory after it has opened its ports.

use std::fs::{self, OpenOptions};
use std::io;

use rustix::fs::FallocateFlags;
use rustix::mm::{Advice, madvise};

use super::learner::SNAPSHOT_SLOTS;
use super::open::{control_buffer, control_slots, segment_slots, transition_buffer};
use super::{ServiceError, failed};
use skein_protocol::config::Config;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::SnapshotLayout;
use skein_protocol::ticket::ControlRecord;
use skein_protocol::transition::TransitionRecord;
use skein_run::{LearnerIncarnation, RunIdentity};

/// Generous estimate of iceoryx2's sample header and alignment.
const SAMPLE_OVERHEAD: usize = 128;
/// Queues and bookkeeping of an actor's ports, beyond what the configuration determines.
const ACTOR_OVERHEAD: usize = 96 << 10;
/// Queues and bookkeeping of the learner's ports, likewise.
const LEARNER_OVERHEAD: usize = 256 << 10;
/// Bookkeeping per possible actor.
const SLOT_OVERHEAD: usize = 3 << 10;

/// Returns the bytes of shared memory that a learner and `actors` actors with `config` need.
pub fn shared_memory_needed(config: &Config, actors: usize) -> u64 {
    let snapshot = SnapshotLayout::of(config).values() * size_of::<f32>() + SAMPLE_OVERHEAD;
    let control =
        control_slots(&config.transport) * (size_of::<ControlRecord>() + SAMPLE_OVERHEAD / 2);
    let segments =
        segment_slots(&config.transport) * (size_of::<SegmentRecord>() + SAMPLE_OVERHEAD / 2);
    let slots = config.transport.max_actors * SLOT_OVERHEAD;
    let learner = SNAPSHOT_SLOTS * snapshot + control + segments + slots + LEARNER_OVERHEAD;
    // Episodes of all tickets, and the records that either side is using.
    let records = transition_buffer(&config.transport) + 8;
    // A queue of eight bytes a message in each direction, and one byte for its owner.
    let queues = 2 * 8 * control_buffer(&config.transport) + control_slots(&config.transport);
    let actor =
        records * (size_of::<TransitionRecord>() + SAMPLE_OVERHEAD) + queues + ACTOR_OVERHEAD;
    (learner + actors * actor) as u64
}

/// Reserves the memory of all segments of `incarnation`.
///
/// # Errors
/// [`ServiceError`] if there is not enough.
pub(super) fn reserve(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
) -> Result<(), ServiceError> {
    for segment in identity.shared_memory(incarnation) {
        match reserve_segment(&segment) {
            // Its owner has removed it in the meantime.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            reserved => reserved.map_err(failed("all", "reserving shared memory"))?,
        }
    }
    Ok(())
}

/// Unmaps the whole pages of `shared`, which lies in a segment, from this process's resident
/// memory. They stay in the segment and are mapped again when read. An actor reads each snapshot
/// once: otherwise the learner's whole segment would count as the actor's memory.
pub(super) fn release_pages(shared: &[u8]) {
    let page = rustix::param::page_size();
    let skipped = shared.as_ptr().align_offset(page);
    let Some(pages) = shared.get(skipped..) else {
        return;
    };
    let whole = pages.len() / page * page;
    if whole == 0 {
        return;
    }
    // SAFETY: these pages lie within `shared`. They are a shared mapping of a file, so the file
    // keeps their content, and any later read gets the same bytes.
    let released = unsafe {
        madvise(
            pages.as_ptr().cast_mut().cast(),
            whole,
            Advice::LinuxDontNeed,
        )
    };
    if let Err(error) = released {
        tracing::debug!(%error, "the pages of a snapshot stay resident");
    }
}

fn reserve_segment(segment: &std::path::Path) -> io::Result<()> {
    use std::os::unix::fs::MetadataExt;
    /// Unit in which the system counts a file's blocks.
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

    /// Returns the resident bytes of shared memory in the mapping that contains `address`.
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
    fn released_pages_leave_this_process_and_are_read_again_unchanged() {
        let mut file = tempfile::tempfile_in("/dev/shm").unwrap();
        let written: Vec<u8> = (0..1 << 20).map(|index| (index % 251) as u8).collect();
        std::io::Write::write_all(&mut file, &written).unwrap();
        // SAFETY: a new mapping of a file that no other process uses.
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
        // SAFETY: the slice covers the mapping, which is never unmapped.
        let shared = unsafe { std::slice::from_raw_parts(start.cast_const(), written.len()) };
        assert_eq!(shared, written);
        let before = resident(start);
        // Not page-aligned: pages shared with other data stay resident.
        release_pages(&shared[100..written.len() - 100]);
        let after = resident(start);
        assert!(
            before >= written.len() && after <= 3 * rustix::param::page_size(),
            "{before} {after}"
        );
        release_pages(&shared[10..20]);
        assert_eq!(shared, written);
    }

    #[test]
    fn the_memory_estimate_covers_what_is_used_and_little_more() {
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
                    "{joined} of {max_actors} actors take {taken} bytes, estimated: {needed}"
                );
                actors.push(ActorPorts::join(&run.identity, &run.config).unwrap());
                learner.maintain().unwrap();
            }
        }
    }
}
