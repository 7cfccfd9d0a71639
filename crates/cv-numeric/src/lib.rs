//! Dense and sparse linear algebra, polynomial roots and least squares for vision.
