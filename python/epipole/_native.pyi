from collections.abc import Callable
from os import PathLike
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epipole._results import Depth, EssentialModel, Matches, Model

__version__: str

class _HasArray(Protocol):
    def __array__(self) -> NDArray[Any]: ...

class _HasDlpack(Protocol):
    def __dlpack__(self) -> Any: ...

_Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32] | _HasArray | _HasDlpack
_Path = str | PathLike[str]
_Progress = Callable[[str, int, int], object]

class StereoMatcher:
    def __new__(
        cls,
        *,
        min_disparity: int | None = 0,
        disparities: int | None = 128,
        census: Literal["5", "7", "9", 5, 7, 9] | None = "5",
        intensity_cost: Literal["none", "gray", "gradient"] | None = "none",
        p1: int | None = 4,
        p2: int | None = 20,
        p2_min: int | None = 4,
        p2_gradient: int | None = 8,
        paths: Literal["4", "8", 4, 8] | None = "8",
        uniqueness: int | None = 0,
        left_right: int | None = 1,
        speckle_size: int | None = 100,
        speckle_range: float | None = 2.0,
        median: int | None = 1,
        smoothing: Literal["none", "bilateral", "wls"] | None = "bilateral",
        fill: bool | None = True,
        max_memory: int | None = None,
        threads: int | None = None,
        progress: _Progress | None = None,
    ) -> StereoMatcher: ...
    def compute(self, left: _Image, right: _Image, *, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]: ...

def depth(
    left: _Image,
    right: _Image,
    *,
    focal: float | None = None,
    baseline: float | None = None,
    offset: float | None = 0.0,
    near: float | None = 0.0,
    far: float | None = float("inf"),
    min_disparity: int | None = None,
    disparities: int | Literal["auto"] | None = 128,
    census: Literal["5", "7", "9", 5, 7, 9] | None = "5",
    intensity_cost: Literal["none", "gray", "gradient"] | None = "none",
    p1: int | None = 4,
    p2: int | None = 20,
    p2_min: int | None = 4,
    p2_gradient: int | None = 8,
    paths: Literal["4", "8", 4, 8] | None = "8",
    uniqueness: int | None = 0,
    left_right: int | None = 1,
    speckle_size: int | None = 100,
    speckle_range: float | None = 2.0,
    median: int | None = 1,
    smoothing: Literal["none", "bilateral", "wls"] | None = "bilateral",
    fill: bool | None = True,
    max_memory: int | None = None,
    confidence: bool | None = False,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Depth: ...
def evaluate_disparity(
    estimate: NDArray[np.float32],
    truth: NDArray[np.float32],
    *,
    mask: NDArray[np.bool_] | NDArray[np.uint8] | None = None,
) -> dict[str, Any]: ...
def match_features(
    a: _Image,
    b: _Image,
    *,
    features: Literal["sift", "mops", "harris"] | None = "sift",
    max_features: int | None = None,
    mutual: bool | None = True,
    affine_simulation: Literal["never", "as-needed", "always"] | None = "as-needed",
    guided: Literal["homography", "fundamental"] | None = None,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Matches: ...
def estimate_homography(
    matches: ArrayLike,
    *,
    threshold: float | None = 3.0,
    confidence: float | None = 0.999,
    max_iterations: int | None = 10000,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Model: ...
def estimate_fundamental(
    matches: ArrayLike,
    *,
    threshold: float | None = 1.0,
    confidence: float | None = 0.999,
    max_iterations: int | None = 20000,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Model: ...
def estimate_essential(
    matches: ArrayLike,
    k1: ArrayLike,
    k2: ArrayLike | None = None,
    *,
    threshold: float | None = 1.0,
    confidence: float | None = 0.999,
    max_iterations: int | None = 20000,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> EssentialModel: ...
def read_image(path: _Path) -> NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]: ...
def write_image(path: _Path, image: _Image) -> None: ...
def read_map(path: _Path, *, scale: float | None = None) -> NDArray[np.float32]: ...
def write_map(path: _Path, map: NDArray[np.float32]) -> None: ...
def is_borrowed(image: _Image) -> bool: ...
def defaults(function: str) -> dict[str, Any]: ...
