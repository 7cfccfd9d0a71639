//! Corners, spacing, descriptors and matching.
