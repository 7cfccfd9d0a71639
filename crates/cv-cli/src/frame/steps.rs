//! The steps of the progress bar, and the library stages that belong to each.

use super::progress::Step;

macro_rules! steps {
    ($($constant:ident = $name:literal: [$($stage:literal),*];)*) => {
        $(pub(crate) const $constant: Step = Step { name: $name, stages: &[$($stage),*] };)*
    };
}

steps! {
    FEATURES = "features": ["features", "scale space", "pyramid", "corners", "describe"];
    RANGE = "range": ["range", "features", "scale space", "pyramid", "corners", "describe", "match"];
    MATCH = "match": ["match", "slanted views", "slanted view"];
    GUIDED = "guided": ["guided", "neighbors"];
    POSE = "pose": ["plane", "lens", "pose"];
    ADJUST = "adjust": ["adjust", "stability"];
    POINTS = "points": ["filter"];
    ALIGN = "align": ["align", "elastic"];
    EXPOSURE = "exposure": ["preview", "exposure"];
    SEAMS = "seams": ["seams"];
    WARP = "warp": ["warp"];
    BLEND = "blend": ["blend", "crop"];
    RECTIFY = "rectify": ["rectify", "reduce"];
    DISPARITIES = "disparities": ["prepare", "bits", "path sums", "aggregate", "check", "refine"];
    EXPAND = "local expansion": ["expand"];
    DEPTH = "depth": ["depth"];
    CLOUD = "cloud": ["cloud"];
    FRAMES = "frames": ["frames"];
    READ = "read": ["read"];
    COLORS = "colors": ["colors", "clusters", "fit"];
    REGIONS = "regions": ["regions"];
    THRESHOLD = "threshold": ["threshold", "scores"];
    PREDICT = "predict": ["predict"];
    SCORE = "score": ["score"];
    BOARDS = "boards": ["boards"];
    LENS = "lens": ["start", "lens"];
    PHOTOGRAPHS = "photographs": ["photographs"];
    PAIRS = "pairs": ["match"];
    MODEL = "model": ["register"];
    UNDISTORT = "undistort": ["undistort"];
    DENSE = "dense": ["reduce", "dense", "join"];
    DEMO = "demo": ["demo"];
}
