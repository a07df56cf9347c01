//! Errors of an update.

use tch::Tensor;

/// Reason why an update was not made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UpdateError {
    /// A loss, a metric or a gradient is infinite or not a number.
    #[error(
        "{tensor} is not finite in update {update}: learning has diverged or its data are damaged; \
         try a smaller learning rate, or resume from a checkpoint"
    )]
    NonFinite {
        /// Name of the loss, metric or gradient.
        tensor: &'static str,
        /// Number of the update, from 1.
        update: u64,
    },
}

/// Returns the values of scalar tensors, after checking that they and all gradients are finite.
///
/// All of them are transferred from the device at once. A gradient whose squared norm overflows
/// also counts as not finite.
pub(crate) fn finite<const SCALARS: usize, const GRADIENTS: usize>(
    update: u64,
    scalars: [(&'static str, &Tensor); SCALARS],
    gradients: [(&'static str, &Tensor); GRADIENTS],
) -> Result<[f32; SCALARS], UpdateError> {
    let values = scalars.iter().map(|(_, scalar)| scalar.detach());
    let norms = gradients.iter().map(|(_, gradient)| gradient.dot(gradient));
    let gathered = Tensor::stack(&values.chain(norms).collect::<Vec<_>>(), 0);
    let mut numbers = vec![0.0; SCALARS + GRADIENTS];
    gathered
        .to_device(tch::Device::Cpu)
        .copy_data(&mut numbers, SCALARS + GRADIENTS);
    let names = scalars
        .iter()
        .map(|(name, _)| *name)
        .chain(gradients.iter().map(|(name, _)| *name));
    must_be_finite(update, names.zip(numbers.iter().copied()))?;
    Ok(std::array::from_fn(|place| numbers[place]))
}

/// Checks that everything update number `update` computed is finite; the error names the first
/// number that is not.
pub(crate) fn must_be_finite(
    update: u64,
    numbers: impl IntoIterator<Item = (&'static str, f32)>,
) -> Result<(), UpdateError> {
    match numbers.into_iter().find(|(_, number)| !number.is_finite()) {
        Some((tensor, _)) => Err(UpdateError::NonFinite { tensor, update }),
        None => Ok(()),
    }
}
