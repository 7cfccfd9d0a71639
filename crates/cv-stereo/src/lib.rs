//! Rectification, semi-global matching, disparity checks and depth.
