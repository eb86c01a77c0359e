//! The cars in a terminal: the full-screen view, and tables and lines of text.

mod keys;
pub(crate) mod screen;
pub(crate) mod text;
