//! Rows times panels, added back through windows.

use skein_kernels::{Finish, Panels, Rows, Start, Windows, product};

/// `image += add_back(rows · panels)`.
pub(super) fn spread(rows: &[f32], panels: &Panels, windows: &Windows, scratch: &mut Vec<f32>, image: &mut [f32]) {
    scratch.resize(windows.count() * windows.window_len(), 0.0);
    product(Rows::Matrix(rows), panels, Start::Zero, Finish::Plain, scratch);
    windows.add_back(scratch, image);
}
