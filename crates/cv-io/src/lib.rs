//! Reading and writing images, disparity and depth maps, clouds, cameras and matches.
