//! Memory for activations.

use std::ops::{Deref, DerefMut};

use bytemuck::{Pod, Zeroable};

/// Numbers in a cache line.
const LINE: usize = 16;

#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([f32; LINE]);

/// Numbers from the beginning of a cache line, kept from use to use. A vector register that is
/// loaded across two lines takes twice the time.
#[derive(Debug, Default)]
pub(super) struct Buffer {
    lines: Vec<Line>,
    len: usize,
}

impl Buffer {
    /// So many noughts.
    pub(super) fn zeroed(len: usize) -> Self {
        Self {
            // The system's own noughts: memory that is never written is never given.
            lines: bytemuck::zeroed_vec(len.div_ceil(LINE)),
            len,
        }
    }

    /// Makes room for `len` numbers, whatever they are. Memory is not given back.
    pub(super) fn resize(&mut self, len: usize) {
        let lines = len.div_ceil(LINE);
        if self.lines.len() < lines {
            self.lines.resize(lines, Line::zeroed());
        }
        self.len = len;
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_begins_where_a_cache_line_does_and_has_the_length_asked_for() {
        let mut buffer = Buffer::zeroed(5);
        for len in [5, 100, 3, 0] {
            buffer.resize(len);
            assert_eq!((buffer.len(), buffer.as_ptr() as usize % 64), (len, 0));
        }
    }
}
