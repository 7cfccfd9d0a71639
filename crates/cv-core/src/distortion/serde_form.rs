//! The serialized form of a distortion: the model's name and its parameters.

use super::{Distortion, DistortionModel};
use serde::{Deserialize, Serialize};

/// A [`Distortion`] as serde writes it.
#[derive(Serialize, Deserialize)]
pub(super) struct SerializedDistortion {
    model: String,
    parameters: Vec<f64>,
}

impl From<Distortion> for SerializedDistortion {
    fn from(distortion: Distortion) -> Self {
        Self { model: distortion.model().info().name.to_owned(), parameters: distortion.parameters().to_vec() }
    }
}

impl TryFrom<SerializedDistortion> for Distortion {
    type Error = String;

    fn try_from(serialized: SerializedDistortion) -> Result<Self, String> {
        let model = DistortionModel::from_name(&serialized.model)
            .ok_or_else(|| format!("there is no lens model “{}”", serialized.model))?;
        Self::new(model, &serialized.parameters).map_err(|error| error.to_string())
    }
}
