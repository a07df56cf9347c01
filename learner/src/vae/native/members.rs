//! Distribution of images over the members of a team.

use skein_kernels::{Isa, Team};

use super::buffer::Buffer;
use super::stopwatch::Stopwatch;
use super::unfold::UnfoldScratch;

/// Working memory of one team member.
#[derive(Debug)]
pub(super) struct MemberScratch {
    pub(super) columns: Vec<f32>,
    pub(super) unfold: UnfoldScratch,
    /// Encoder outputs of one image, for encoding without a batch.
    pub(super) images: [Buffer; 5],
    pub(super) watch: Stopwatch,
}

impl MemberScratch {
    pub(super) fn new(isa: Isa) -> Self {
        Self {
            columns: Vec::new(),
            unfold: UnfoldScratch::new(isa),
            images: Default::default(),
            watch: Stopwatch::default(),
        }
    }
}

/// Splits `items` among the members, in order, and calls `work` with each item's index and the
/// item.
pub(super) fn share<T: Send>(
    team: &mut Team,
    members: &mut [MemberScratch],
    items: &mut [T],
    work: impl Fn(usize, &mut T, &mut MemberScratch) + Sync,
) {
    let (size, count) = (members.len(), items.len());
    let (mut rest, mut first) = (items, 0);
    let mut shares = Vec::with_capacity(size);
    for (index, member) in members.iter_mut().enumerate() {
        let end = count * (index + 1) / size;
        let (own, others) = rest.split_at_mut(end - first);
        shares.push((first, own, member));
        (rest, first) = (others, end);
    }
    team.split_rows(&mut shares, 1, 1, |_, shares| {
        for (first, own, member) in shares {
            member.watch.start();
            for (index, item) in own.iter_mut().enumerate() {
                work(*first + index, item, member);
            }
        }
    });
}

/// Splits every buffer into the parts that belong to each of `count` images.
pub(super) fn by_image<const N: usize>(
    buffers: [&mut [f32]; N],
    count: usize,
) -> Vec<[&mut [f32]; N]> {
    let mut parts = buffers.map(|buffer| buffer.chunks_exact_mut(buffer.len() / count));
    (0..count)
        .map(|_| std::array::from_fn(|index| parts[index].next().expect("a part for each image")))
        .collect()
}

/// Splits `rows`, each `len` long, into one part per member, with the index of its first row. With
/// too few rows, there are fewer parts.
pub(super) fn portions(rows: &mut [f32], len: usize, members: usize) -> Vec<(usize, &mut [f32])> {
    let each = (rows.len() / len).div_ceil(members).max(1);
    let portions = rows.chunks_mut(each * len).enumerate();
    portions.map(|(index, rows)| (index * each, rows)).collect()
}
