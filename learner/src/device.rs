//! The device that the learner computes on.

use skein_protocol::config;
use tch::{Cuda, Device};

/// Reason why the configured device cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// This libtorch has no CUDA at all.
    #[error(
        "run.device = cuda:{number}: this libtorch has no CUDA; set run.device = \"cpu\", \
         or build with LIBTORCH naming a CUDA build of libtorch 2.13"
    )]
    WithoutCuda {
        /// Number of the requested device.
        number: usize,
    },
    /// libtorch has CUDA, but not this device.
    #[error(
        "run.device = cuda:{number}: libtorch finds {count} CUDA devices, numbered from 0; \
         see nvidia-smi, or set run.device = \"cpu\""
    )]
    NoSuchDevice {
        /// Number of the requested device.
        number: usize,
        /// Number of devices found.
        count: i64,
    },
}

/// Returns libtorch's name for the configured device, after checking that it exists.
///
/// # Errors
/// [`DeviceError`] says what is missing and what to do.
pub fn open(device: config::Device) -> Result<Device, DeviceError> {
    match device {
        config::Device::Cpu => Ok(Device::Cpu),
        config::Device::Cuda(number) => {
            if !tch::utils::has_cuda() {
                return Err(DeviceError::WithoutCuda { number });
            }
            let count = Cuda::device_count();
            if number as i64 >= count {
                return Err(DeviceError::NoSuchDevice { number, count });
            }
            // With benchmarking, cuDNN chooses algorithms by timing them, and results would depend
            // on the machine's load.
            Cuda::cudnn_set_benchmark(false);
            Ok(Device::Cuda(number))
        }
    }
}

/// Sets the number of threads for the calling thread's tensor operations. It affects the result:
/// another count sums in another order.
pub fn use_threads(count: usize) {
    tch::set_num_threads(count as i32);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_does_not_exist_is_refused_with_a_remedy() {
        let error = open(config::Device::Cuda(1000)).unwrap_err();
        let text = error.to_string();
        assert!(
            text.starts_with("run.device = cuda:1000: ")
                && text.contains("set run.device = \"cpu\""),
            "{text}"
        );
    }

    #[test]
    fn the_cpu_is_always_available() {
        assert_eq!(open(config::Device::Cpu), Ok(Device::Cpu));
    }
}
