//! Every reader on a synthetic sample that the test writes; bad input; mutated files.

mod bad_input;
mod depth;
mod far;
mod flow;
mod forgiving;
mod found;
mod geometry;
mod labels;
mod layouts;
mod mutants;
mod pictures;
pub(super) mod samples;
mod tracks;
mod variants;
