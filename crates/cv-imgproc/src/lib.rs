//! Colour conversion, filtering, sampling, warping, pyramids, morphology and components.
