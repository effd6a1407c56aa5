//! Real spherical harmonics up to degree 3.
