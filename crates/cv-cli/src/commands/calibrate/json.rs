//! The JSON object of a calibration.

use super::Job;
use crate::boards::board_options;
use crate::frame::Outcome;
use crate::words::calibration::{lens, note, refusal};
use serde_json::{Map, Value, json};

/// Maps camera names to values; for a single camera, the value alone.
fn by_camera(job: &Job, of: &dyn Fn(usize) -> Value) -> Value {
    match job.names.as_slice() {
        [_] => of(0),
        names => Value::Object(names.iter().enumerate().map(|(c, name)| (name.clone(), of(c))).collect()),
    }
}

pub(super) fn outcome(job: &Job) -> Outcome {
    let found = &job.found;
    let c = &found.calibration;
    let parameters = |camera: Option<usize>| -> Map<String, Value> {
        let own = c.parameters.iter().filter(|p| p.camera == camera);
        own.map(|p| (p.name.to_owned(), json!({ "value": p.value, "deviation": p.deviation }))).collect()
    };
    let mut all = match job.names.as_slice() {
        [_] => parameters(Some(0)),
        names => names.iter().enumerate().map(|(i, n)| (n.clone(), parameters(Some(i)).into())).collect(),
    };
    let board = parameters(None);
    if !board.is_empty() {
        all.insert("board".to_owned(), board.into());
    }
    let mut rms = by_camera(job, &|i| json!(c.cameras[i].rms_px));
    let mut holdout = by_camera(job, &|i| json!(c.cameras[i].holdout_rms_px));
    let mut holdout_all = by_camera(job, &|i| json!(c.cameras[i].holdout_all_rms_px));
    if job.names.len() == 2 {
        let together =
            [(&mut rms, c.rms_px), (&mut holdout, c.holdout_rms_px), (&mut holdout_all, c.holdout_all_rms_px)];
        for (values, of_rig) in together {
            if let Value::Object(values) = values {
                values.insert("stereo".to_owned(), json!(of_rig));
            }
        }
    }
    let image_json = |view: usize, camera: usize| {
        let of = &c.views[view].images[camera];
        json!({
            "path": job.path(view, camera).map(|p| p.display().to_string()),
            "used": found.refusals[view][camera].is_none(),
            "rms_px": of.rms_px,
            "corners": of.corners.iter().filter(|c| c.used).count(),
            "outliers": of.corners.iter().filter(|c| !c.used).count(),
            "reason": found.refusals[view][camera].as_ref().map(refusal),
        })
    };
    let views: Vec<Value> = (0..c.views.len())
        .map(|view| match job.names.as_slice() {
            [_] => image_json(view, 0),
            names => {
                let mut all: Map<String, Value> =
                    names.iter().enumerate().map(|(i, name)| (name.clone(), image_json(view, i))).collect();
                let used = found.refusals[view].iter().all(Option::is_none);
                let corners = c.views[view].images.iter().flat_map(|p| &p.corners).filter(|c| c.used);
                let (sum, n) =
                    corners.filter_map(|c| c.residual).fold((0.0, 0), |s, r| (s.0 + r.norm_squared(), s.1 + 1));
                let reasons: Vec<String> = names
                    .iter()
                    .zip(&found.refusals[view])
                    .filter_map(|(name, r)| Some(format!("{name}: {}", refusal(r.as_ref()?))))
                    .collect();
                all.insert("used".to_owned(), used.into());
                all.insert("rms_px".to_owned(), json!((sum / f64::from(n)).sqrt()));
                all.insert("reason".to_owned(), json!((!reasons.is_empty()).then(|| reasons.join("; "))));
                Value::Object(all)
            }
        })
        .collect();
    let lenses = |i: usize| -> Value {
        let rows = c.cameras[i].lenses.iter().map(|trial| {
            json!({
                "lens": trial.model.info().name,
                "rms_px": trial.rms_px,
                "holdout_rms_px": trial.holdout_rms_px,
                "outliers": trial.outliers,
                "verdict": lens(trial),
            })
        });
        rows.collect()
    };
    let outcome = Outcome::new(found.stages.clone())
        .with("rms_px", rms)
        .with("holdout_rms_px", holdout)
        .with("holdout_all_rms_px", holdout_all)
        .with("noise_px", c.noise_px)
        .with("lens", by_camera(job, &|i| json!(c.cameras[i].camera.distortion.model().info().name)))
        .with("lenses", by_camera(job, &lenses))
        .with("parameters", all)
        .with(
            "board",
            json!({
                "kind": found.board.kind().to_string(),
                "columns": found.board.counts().0,
                "rows": found.board.counts().1,
                "options": board_options(&found.board),
            }),
        )
        .with("board_deflection", json!({ "x": c.target_shape.deflection[0], "y": c.target_shape.deflection[1], "adjusted": c.target_shape.adjusted }))
        .with("unit", &job.unit)
        .with(
            "uncertainty_px",
            by_camera(job, &|i| {
                let map = &c.cameras[i].uncertainty;
                json!({ "median": map.median(), "worst": map.worst().map(|w| w.1) })
            }),
        )
        .with(
            "verdict",
            json!({
                "trust": c.verdict.trust.to_string(),
                "notes": c.verdict.notes.iter().map(|n| note(n, &job.names)).collect::<Vec<_>>(),
            }),
        )
        .with(
            match job.names.len() {
                1 => "images",
                2 => "pairs",
                _ => "views",
            },
            views,
        );
    if job.names.len() > 2 {
        let rows = |i: usize| -> Vec<Vec<f64>> {
            c.cameras[i].from_first.rotation.matrix().row_iter().map(|r| r.iter().copied().collect()).collect()
        };
        return outcome
            .with("rotation", by_camera(job, &|i| json!(rows(i))))
            .with("translation", by_camera(job, &|i| json!(c.cameras[i].from_first.translation.as_slice())));
    }
    match c.stereo() {
        None => outcome,
        Some(rig) => outcome
            .with("rectified_dy_mean_px", found.rectified_dy_px.map(|r| r.0))
            .with("rectified_dy_max_px", found.rectified_dy_px.map(|r| r.1))
            .with("baseline", rig.baseline())
            .with("translation", rig.right_from_left.translation.as_slice()),
    }
}
