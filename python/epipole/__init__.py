"""Classical computer vision over NumPy arrays: calibration, stereo depth, matching, two and many views, panoramas, color segmentation.

Images are arrays of uint8, uint16 or float32, of shape (height, width) or (height, width, 3) in RGB; invalid values of maps are NaN. Options are
keyword arguments; ``defaults("depth")`` lists those of a function. Failures raise an exception of :mod:`epipole.errors` with the numbers as attributes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from epipole._native import (
    Camera,
    Rig,
    SfmPhotograph,
    StereoMatcher,
    Undistorter,
    __version__,
    calibrate,
    defaults,
    depth,
    estimate_essential,
    estimate_fundamental,
    estimate_homography,
    estimate_pose,
    evaluate_disparity,
    evaluate_mask,
    extract_features,
    find_board,
    is_borrowed,
    match,
    match_features,
    panorama,
    read_image,
    read_map,
    reconstruct,
    rectify,
    sfm,
    sfm_features,
    undistort,
    write_cloud,
    write_image,
    write_map,
)

if TYPE_CHECKING:
    from epipole import boards as boards
    from epipole import errors as errors
    from epipole import ray as ray
    from epipole._results import (
        BoardView as BoardView,
        Calibration as Calibration,
        Depth as Depth,
        EssentialModel as EssentialModel,
        Features as Features,
        Located as Located,
        Matches as Matches,
        Model as Model,
        ModelImage as ModelImage,
        Object as Object,
        Panorama as Panorama,
        PointCloud as PointCloud,
        PoseModel as PoseModel,
        Reconstruction as Reconstruction,
        Rectified as Rectified,
        SfmResult as SfmResult,
        TwoViewReconstruction as TwoViewReconstruction,
    )
    from epipole.boards import AprilGrid, ArucoGrid, CharucoBoard, Chessboard
    from epipole.color_model import ColorModel

__all__ = [
    "AprilGrid",
    "ArucoGrid",
    "Camera",
    "CharucoBoard",
    "Chessboard",
    "ColorModel",
    "Features",
    "PointCloud",
    "Reconstruction",
    "Rig",
    "SfmPhotograph",
    "StereoMatcher",
    "Undistorter",
    "__version__",
    "boards",
    "calibrate",
    "defaults",
    "depth",
    "errors",
    "estimate_essential",
    "estimate_fundamental",
    "estimate_homography",
    "estimate_pose",
    "evaluate_disparity",
    "evaluate_mask",
    "extract_features",
    "find_board",
    "is_borrowed",
    "match",
    "match_features",
    "panorama",
    "read_image",
    "read_map",
    "reconstruct",
    "rectify",
    "sfm",
    "sfm_features",
    "undistort",
    "write_cloud",
    "write_image",
    "write_map",
]

# Imported lazily, to keep the import of the package fast.
_LAZY = {
    "AprilGrid": "boards",
    "ArucoGrid": "boards",
    "CharucoBoard": "boards",
    "Chessboard": "boards",
    "ColorModel": "color_model",
    "Features": "_results",
    "PointCloud": "_results",
    "Reconstruction": "_results",
}
_RESULTS = (
    "BoardView",
    "Calibration",
    "Depth",
    "EssentialModel",
    "Located",
    "Matches",
    "Model",
    "ModelImage",
    "Object",
    "Panorama",
    "PoseModel",
    "Rectified",
    "SfmResult",
    "TwoViewReconstruction",
)


def __getattr__(name: str) -> Any:
    import importlib

    if name in ("boards", "errors", "ray"):
        return importlib.import_module(f"epipole.{name}")
    module = _LAZY.get(name, "_results" if name in _RESULTS else None)
    if module is None:
        raise AttributeError(f"module 'epipole' has no attribute {name!r}")
    return getattr(importlib.import_module(f"epipole.{module}"), name)
