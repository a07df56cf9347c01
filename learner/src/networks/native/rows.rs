//! Row operations that every actor-critic needs, and the step of a target network.

use skein_kernels::{Isa, Team, exp};

/// Q estimates per row of a critic.
pub const ESTIMATES: usize = 2;

/// Concatenates observations and actions row by row. An action has `action` numbers.
pub fn join(observations: &[f32], actions: &[f32], action: usize, into: &mut [f32]) {
    let rows = actions.len() / action;
    let (observation, width) = (observations.len() / rows, into.len() / rows);
    for (row, into) in into.chunks_exact_mut(width).enumerate() {
        into[..observation].copy_from_slice(&observations[row * observation..][..observation]);
        into[observation..].copy_from_slice(&actions[row * action..][..action]);
    }
}

/// Both estimates of one row.
pub fn pair(values: &[f32], row: usize) -> [f32; ESTIMATES] {
    [values[row * ESTIMATES], values[row * ESTIMATES + 1]]
}

/// The smaller estimate; NaN if either of them is NaN.
pub fn smaller([one, other]: [f32; ESTIMATES]) -> f32 {
    if one < other || one.is_nan() {
        one
    } else {
        other
    }
}

/// Returns tanh x, its derivative, and e = exp(-2|x|): tanh|x| = (1 - e) / (1 + e), the derivative
/// is 4 e / (1 + e)². Both stay exact where tanh saturates.
#[inline(always)]
pub fn squash(x: f32) -> [f32; 3] {
    let e = exp(-2.0 * x.abs());
    [
        ((1.0 - e) / (1.0 + e)).copysign(x),
        4.0 * e / ((1.0 + e) * (1.0 + e)),
        e,
    ]
}

/// Moves a target network towards its leader, by the fraction `rate` of their difference.
pub fn follow(team: &mut Team, isa: Isa, target: &mut [f32], leader: &[f32], rate: f32) {
    /// Numbers that stay together: whole cache lines.
    const GRAIN: usize = 1024;
    team.split_rows(target, 1, GRAIN, |first, own| {
        isa.vectorised(
            #[inline(always)]
            || {
                for (own, leader) in own.iter_mut().zip(&leader[first..]) {
                    *own = (leader - *own).mul_add(rate, *own);
                }
            },
        );
    });
}
