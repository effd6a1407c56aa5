//! Small studies on made-up motion, where the truth is known: what a deformation network learns (E00) and what lifting and
//! integrating optical flow can and cannot do (E01). Pure functions of their settings: no files, no clock.

pub mod e00;
pub mod e01;
