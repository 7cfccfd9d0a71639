//! Homography, epipolar geometry, pose, triangulation, and the one RANSAC driver.
