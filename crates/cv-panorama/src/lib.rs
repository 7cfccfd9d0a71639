//! Projections, alignment, exposure, seams and blending of overlapping photographs.
