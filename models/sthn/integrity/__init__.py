"""From evidence to numbers: trials, the calibrated model, its report. What Rust evaluates is in `src/model/integrity.rs`."""
