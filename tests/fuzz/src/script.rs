//! Reads an input as a sequence of choices, for targets that build inputs which random bytes would
//! hardly ever form.

/// Rest of an input. Once it is used up every choice is zero, so that any bytes are a script.
pub(crate) struct Script<'a>(&'a [u8]);

impl<'a> Script<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub(crate) fn is_over(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the next `count` bytes, or as many as are left.
    pub(crate) fn bytes(&mut self, count: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }

    fn array<const N: usize>(&mut self) -> [u8; N] {
        let mut array = [0; N];
        let taken = self.bytes(N);
        array[..taken.len()].copy_from_slice(taken);
        array
    }

    pub(crate) fn u8(&mut self) -> u8 {
        self.array::<1>()[0]
    }

    pub(crate) fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.array())
    }

    pub(crate) fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.array())
    }

    pub(crate) fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.array())
    }

    /// Returns one of `choices`.
    pub(crate) fn one_of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[usize::from(self.u8()) % choices.len()]
    }

    /// Returns mostly a number from `usual`, in 65536 steps; sometimes any float, and sometimes a
    /// notorious one.
    pub(crate) fn number(&mut self, usual: std::ops::RangeInclusive<f32>) -> f32 {
        const TROUBLE: [f32; 12] = [
            0.0,
            -0.0,
            1.0,
            f32::NAN,
            f32::INFINITY,
            f32::NEG_INFINITY,
            f32::MAX,
            f32::MIN,
            f32::MIN_POSITIVE,
            f32::EPSILON,
            1e-45,
            -1.0,
        ];
        match self.u8() {
            0..=239 => {
                let share = f32::from(self.u16()) / f32::from(u16::MAX);
                usual.start() + share * (usual.end() - usual.start())
            }
            240..=247 => f32::from_bits(self.u32()),
            _ => self.one_of(&TROUBLE),
        }
    }
}
