//! Distortion as data: the model by its name in our own files, and as many parameters as it has.

use super::{Distortion, DistortionModel};
use serde::{Deserialize, Serialize};

/// What stands for a [`Distortion`] in a file.
#[derive(Serialize, Deserialize)]
pub(super) struct Stored {
    model: String,
    parameters: Vec<f64>,
}

impl From<Distortion> for Stored {
    fn from(distortion: Distortion) -> Self {
        Self { model: distortion.model().info().name.to_owned(), parameters: distortion.parameters().to_vec() }
    }
}

impl TryFrom<Stored> for Distortion {
    type Error = String;

    fn try_from(stored: Stored) -> Result<Self, String> {
        let model = DistortionModel::from_name(&stored.model)
            .ok_or_else(|| format!("there is no lens model “{}”", stored.model))?;
        Self::new(model, &stored.parameters).map_err(|error| error.to_string())
    }
}
