//! Gaussian and mixture colour models, posterior classification, mask clean-up and scores.
