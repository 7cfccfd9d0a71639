//! Ray-cast scenes with exact ground truth.
