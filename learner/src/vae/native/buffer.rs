//! Memory for activations.

use std::ops::{Deref, DerefMut};

use bytemuck::{Pod, Zeroable};

/// f32 numbers per cache line.
const LINE: usize = 16;

#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct BufferLine([f32; LINE]);

/// A buffer of numbers, aligned to a cache line and reused. Loading a vector register across two
/// lines takes twice the time.
#[derive(Debug, Default)]
pub(super) struct Buffer {
    lines: Vec<BufferLine>,
    len: usize,
}

impl Buffer {
    /// Allocates `len` zeros.
    pub(super) fn zeroed(len: usize) -> Self {
        Self {
            // The system's own zeroed pages: memory that is never written is never allocated.
            lines: bytemuck::zeroed_vec(len.div_ceil(LINE)),
            len,
        }
    }

    /// Makes room for `len` numbers of any value. Memory is not released.
    pub(super) fn resize(&mut self, len: usize) {
        let lines = len.div_ceil(LINE);
        if self.lines.len() < lines {
            self.lines.resize(lines, BufferLine::zeroed());
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
    fn a_buffer_starts_at_a_cache_line_and_has_the_requested_length() {
        let mut buffer = Buffer::zeroed(5);
        for len in [5, 100, 3, 0] {
            buffer.resize(len);
            assert_eq!((buffer.len(), buffer.as_ptr() as usize % 64), (len, 0));
        }
    }
}
