//! What can go wrong in an update.

use tch::Tensor;

/// Why an update was not done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UpdateError {
    /// A loss, a metric or a gradient is infinite or not a number.
    #[error(
        "{tensor} is not finite in update {update}: learning has diverged or its data are damaged; try a smaller learning rate, or resume from a checkpoint"
    )]
    NonFinite {
        /// What.
        tensor: &'static str,
        /// The update's number, from 1.
        update: u64,
    },
}

/// The values of scalar tensors, once they and all of the gradients are known to be finite.
///
/// One transfer from the device for all of them. A gradient counts as not finite when its squared
/// norm overflows as well.
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

/// Looks whether everything that update number `update` computed is a number; the first that is not
/// is named.
pub(crate) fn must_be_finite(
    update: u64,
    numbers: impl IntoIterator<Item = (&'static str, f32)>,
) -> Result<(), UpdateError> {
    match numbers.into_iter().find(|(_, number)| !number.is_finite()) {
        Some((tensor, _)) => Err(UpdateError::NonFinite { tensor, update }),
        None => Ok(()),
    }
}
