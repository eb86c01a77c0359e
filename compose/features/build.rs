//! Empty: without it Cargo leaves build dependencies out.

fn main() {}
