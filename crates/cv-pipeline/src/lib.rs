//! One call per job: segment, panorama, match, estimate, reconstruct, depth.
