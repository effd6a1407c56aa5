//! Every reader on a made-up sample that the test writes; bad input; mutated files.

mod bad_input;
mod depth;
mod flow;
mod forgiving;
mod labels;
mod layouts;
mod mutants;
mod pictures;
mod samples;
mod tracks;
