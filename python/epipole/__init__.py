"""Classical computer vision over NumPy arrays: stereo depth, matching, two-view geometry.

Images are arrays of uint8, uint16 or float32, of shape (height, width) or (height, width, 3) in RGB; unknown values of maps are NaN. Options are
given by name; ``defaults("depth")`` lists those of a function. What cannot be done raises an exception of :mod:`epipole.errors` with the numbers.
"""

from epipole._native import (
    StereoMatcher,
    __version__,
    defaults,
    depth,
    estimate_essential,
    estimate_fundamental,
    estimate_homography,
    evaluate_disparity,
    is_borrowed,
    match_features,
    read_image,
    read_map,
    write_image,
    write_map,
)

__all__ = [
    "StereoMatcher",
    "__version__",
    "defaults",
    "depth",
    "errors",
    "estimate_essential",
    "estimate_fundamental",
    "estimate_homography",
    "evaluate_disparity",
    "is_borrowed",
    "match_features",
    "read_image",
    "read_map",
    "write_image",
    "write_map",
]

_RESULTS = ("Depth", "EssentialModel", "Matches", "Model")


def __getattr__(name):
    # The classes of results, and the errors, are loaded when they are needed: the import stays short.
    if name in _RESULTS:
        from epipole import _results

        return getattr(_results, name)
    if name == "errors":
        import importlib

        return importlib.import_module("epipole.errors")
    raise AttributeError(f"module 'epipole' has no attribute {name!r}")
