from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Literal, Protocol, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epipole._results import (
    BoardView,
    Calibration,
    Depth,
    EssentialModel,
    Features,
    Located,
    Matches,
    Model,
    Panorama,
    PoseModel,
    Reconstruction,
    Rectified,
    SfmResult,
    TwoViewReconstruction,
)
from epipole.boards import AprilGrid, ArucoGrid, CharucoBoard, Chessboard

__version__: str

class _HasArray(Protocol):
    def __array__(self) -> NDArray[Any]: ...

class _HasDlpack(Protocol):
    def __dlpack__(self) -> Any: ...

_Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32] | _HasArray | _HasDlpack
_Path = str | PathLike[str]
_Progress = Callable[[str, int, int], object]
_Size = tuple[int, int]
_Photograph = NDArray[np.uint8] | _HasArray | _HasDlpack | _Path
_Board = Chessboard | CharucoBoard | ArucoGrid | AprilGrid
_Mask = NDArray[np.bool_] | NDArray[np.uint8]

@final
class Camera:
    def __new__(
        cls,
        width: int,
        height: int,
        matrix: ArrayLike,
        distortion: ArrayLike | None = None,
        lens: str | None = None,
    ) -> Camera: ...
    @staticmethod
    def from_focal(width: int, height: int, focal: float) -> Camera: ...
    @staticmethod
    def read(path: _Path, *, size: _Size | None = None) -> Camera: ...
    def write(self, path: _Path, *, format: str = "own") -> None: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def matrix(self) -> NDArray[np.float64]: ...
    @property
    def distortion(self) -> NDArray[np.float64]: ...
    @property
    def lens(self) -> str: ...
    def project(self, points: ArrayLike) -> NDArray[np.float64]: ...
    def normalize(self, pixels: ArrayLike) -> NDArray[np.float64]: ...
    def undistort_points(self, pixels: ArrayLike) -> NDArray[np.float64]: ...
    def resized(self, width: int, height: int) -> Camera: ...
    def __eq__(self, other: object, /) -> bool: ...
    def __hash__(self) -> int: ...

@final
class Rig:
    def __new__(
        cls, left: Camera, right: Camera, rotation: ArrayLike, translation: ArrayLike, unit: str = ""
    ) -> Rig: ...
    @staticmethod
    def read(path: _Path | Sequence[_Path], *, size: _Size | None = None) -> Rig: ...
    def write(self, path: _Path, *, format: str = "own") -> None: ...
    @property
    def left(self) -> Camera: ...
    @property
    def right(self) -> Camera: ...
    @property
    def rotation(self) -> NDArray[np.float64]: ...
    @property
    def translation(self) -> NDArray[np.float64]: ...
    @property
    def baseline(self) -> float: ...
    @property
    def unit(self) -> str: ...
    def exchanged(self) -> Rig: ...
    def __eq__(self, other: object, /) -> bool: ...

@final
class Undistorter:
    def __new__(
        cls,
        camera: Camera,
        *,
        alpha: float | None = 0.0,
        size: _Size | None = None,
        threads: int | None = None,
        progress: _Progress | None = None,
    ) -> Undistorter: ...
    @property
    def camera(self) -> Camera: ...
    def compute(self, image: _Image) -> NDArray[Any]: ...

@final
class SfmPhotograph:
    @property
    def name(self) -> str: ...
    @property
    def size(self) -> _Size: ...
    @property
    def focal(self) -> float | None: ...
    @property
    def gps(self) -> tuple[float, float, float | None] | None: ...
    @property
    def keypoints(self) -> NDArray[np.float32]: ...
    def __len__(self) -> int: ...
    @staticmethod
    def _of_parts(
        name: str,
        size: _Size,
        exif: tuple[float | None, tuple[float, float, float | None] | None],
        keypoints: ArrayLike,
        descriptors: bytes,
        kind: str,
        colors: ArrayLike,
    ) -> SfmPhotograph: ...

@final
class FittedColorModel:
    @staticmethod
    def fit(
        images: Sequence[_Image], masks: Sequence[_Mask], **options: Any
    ) -> tuple[FittedColorModel, tuple[dict[str, Any], ...]]: ...
    def predict(self, image: _Image) -> NDArray[np.bool_]: ...
    def log_odds(self, image: _Image) -> NDArray[np.float32]: ...
    def locate(
        self,
        image: _Image,
        *,
        min_score: float | None = None,
        threads: int | None = None,
        progress: _Progress | None = None,
    ) -> Located: ...
    @property
    def threshold(self) -> float: ...
    def to_json(self) -> str: ...
    @staticmethod
    def from_json(text: str) -> FittedColorModel: ...

@final
class StereoMatcher:
    def __new__(
        cls,
        *,
        min_disparity: int | None = 0,
        disparities: int | None = 128,
        census: Literal["5", "7", "9", 5, 7, 9] | None = "5",
        intensity_cost: Literal["none", "gray", "gradient"] | None = "none",
        p1: int | None = 4,
        p2: int | None = 24,
        p2_min: int | None = 4,
        p2_gradient: int | None = 8,
        pyramid_levels: int | None = 2,
        search: Literal["auto", "full", "hierarchical"] | None = "auto",
        paths: Literal["4", "8", 4, 8] | None = "8",
        uniqueness: int | None = 0,
        left_right: int | None = 1,
        speckle_size: int | None = 100,
        speckle_range: float | None = 2.0,
        median: int | None = 1,
        smoothing: Literal["none", "bilateral", "wls"] | None = "bilateral",
        fill: bool | None = True,
        ignore_black_borders: bool | None = True,
        denoise: bool | None = True,
        quality: bool | None = False,
        max_memory: int | None = None,
        sequence: bool | None = False,
        threads: int | None = None,
        progress: _Progress | None = None,
    ) -> StereoMatcher: ...
    def compute(self, left: _Image, right: _Image, *, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]: ...

@final
class PairDepth:
    def __new__(cls, **options: Any) -> PairDepth: ...
    def compute(self, left: _Image, right: _Image) -> Depth: ...

def depth(
    left: _Image,
    right: _Image,
    *,
    focal: float | None = None,
    baseline: float | None = None,
    offset: float | None = 0.0,
    rig: Rig | None = None,
    alpha: float | None = 0.0,
    size: _Size | None = None,
    few_matches: Literal["check", "keep"] | None = "check",
    align: bool | None = True,
    near: float | None = 0.0,
    far: float | None = float("inf"),
    cloud: bool | None = False,
    min_disparity: int | None = None,
    disparities: int | Literal["auto"] | None = 128,
    census: Literal["5", "7", "9", 5, 7, 9] | None = "5",
    intensity_cost: Literal["none", "gray", "gradient"] | None = "none",
    p1: int | None = 4,
    p2: int | None = 24,
    p2_min: int | None = 4,
    p2_gradient: int | None = 8,
    pyramid_levels: int | None = 2,
    search: Literal["auto", "full", "hierarchical"] | None = "auto",
    paths: Literal["4", "8", 4, 8] | None = "8",
    uniqueness: int | None = 0,
    left_right: int | None = 1,
    speckle_size: int | None = 100,
    speckle_range: float | None = 2.0,
    median: int | None = 1,
    smoothing: Literal["none", "bilateral", "wls"] | None = "bilateral",
    fill: bool | None = True,
    ignore_black_borders: bool | None = True,
    denoise: bool | None = True,
    quality: bool | None = False,
    max_memory: int | None = None,
    confidence: bool | None = False,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Depth: ...
def evaluate_disparity(
    estimate: NDArray[np.float32],
    truth: NDArray[np.float32],
    *,
    mask: _Mask | None = None,
) -> dict[str, Any]: ...
def evaluate_mask(mask: _Mask, truth: _Mask) -> dict[str, Any]: ...
def rectify(
    left: _Image,
    right: _Image,
    rig: Rig,
    *,
    alpha: float | None = 0.0,
    size: _Size | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Rectified: ...
def undistort(
    image: _Image,
    camera: Camera,
    *,
    alpha: float | None = 0.0,
    size: _Size | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> tuple[NDArray[Any], Camera]: ...
def find_board(
    image: _Image,
    *,
    board: _Board | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> BoardView: ...
def calibrate(
    photographs: Sequence[_Photograph | None] | Sequence[Sequence[_Photograph | None]],
    *,
    board: _Board | None = None,
    lens: Literal["auto", "radial-tangential4", "radial-tangential5", "rational8", "thin-prism12", "fisheye4"] | None = "auto",
    board_shape: bool | None = True,
    outlier_deviations: float | None = 4.5,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Calibration: ...
def extract_features(
    image: _Image,
    *,
    features: Literal["sift", "mops", "harris"] | None = "sift",
    max_features: int | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Features: ...
def match(
    a: Features,
    b: Features,
    *,
    mutual: bool | None = True,
    guided: Literal["homography", "fundamental"] | None = None,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Matches: ...
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
    k1: Camera | ArrayLike,
    k2: Camera | ArrayLike | None = None,
    *,
    threshold: float | None = 1.0,
    confidence: float | None = 0.999,
    max_iterations: int | None = 20000,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> EssentialModel: ...
def estimate_pose(
    points: ArrayLike,
    pixels: ArrayLike,
    camera: Camera,
    *,
    threshold: float | None = 4.0,
    confidence: float | None = 0.999,
    max_iterations: int | None = 20000,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> PoseModel: ...
def reconstruct(
    a: _Photograph,
    b: _Photograph,
    *,
    camera: Camera | ArrayLike | None = None,
    camera2: Camera | ArrayLike | None = None,
    focal: float | None = None,
    ignore_exif: bool | None = False,
    threshold: float | None = 2.0,
    max_error: float | None = 2.0,
    min_angle: float | None = 0.0017453292519943296,
    max_features: int | None = None,
    seed: int | None = 0,
    dense: bool | None = False,
    dense_size: int | None = 1600,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> TwoViewReconstruction: ...
def sfm_features(
    photograph: _Photograph,
    *,
    name: str | None = None,
    max_features: int | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> SfmPhotograph: ...
def sfm(
    photographs: Sequence[_Photograph | SfmPhotograph],
    *,
    camera: Camera | ArrayLike | None = None,
    focal: float | None = None,
    ignore_exif: bool | None = False,
    names: Sequence[str] | None = None,
    centers: ArrayLike | None = None,
    distances: Sequence[tuple[int, int, float]] | None = None,
    ignore_gps: bool | None = False,
    solver: Literal["auto", "incremental", "global"] | None = "auto",
    order: Literal["any", "sequence"] | None = "any",
    max_error: float | None = 2.5,
    max_features: int | None = None,
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> SfmResult: ...
def panorama(
    photographs: Sequence[_Photograph | NDArray[np.uint16]],
    *,
    camera: Camera | None = None,
    focal: float | None = None,
    registration: str | None = None,
    mode: Literal["auto", "rotation", "plane"] | None = "auto",
    projection: Literal["auto", "plane", "cylindrical", "spherical", "mercator", "panini", "stereographic"] | None = "auto",
    fov: float | tuple[float, float] | None = None,
    center: tuple[float, float] | None = None,
    roll: float | None = 0.0,
    blend: Literal["multiband", "poisson", "feather", "none"] | None = "multiband",
    seams: Literal["graphcut", "voronoi"] | None = "graphcut",
    clean: bool | None = False,
    keep: Sequence[_Mask | None] | None = None,
    remove: Sequence[_Mask | None] | None = None,
    exposure: Literal["none", "match", "adapt"] | None = "match",
    crop: bool | None = False,
    scale: float | None = 1.0,
    features: Literal["sift", "mops", "harris"] | None = "sift",
    seed: int | None = 0,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Panorama: ...
def read_model(folder: _Path) -> Reconstruction: ...
def write_model(
    folder: _Path, model: Reconstruction, *, format: Literal["colmap-text", "colmap-binary"] = "colmap-text"
) -> None: ...
def write_cloud(
    path: _Path, positions: ArrayLike, colors: ArrayLike | None = None, normals: ArrayLike | None = None
) -> None: ...
def read_image(path: _Path) -> NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]: ...
def write_image(path: _Path, image: _Image) -> None: ...
def read_map(path: _Path, *, scale: float | None = None) -> NDArray[np.float32]: ...
def write_map(path: _Path, map: NDArray[np.float32]) -> None: ...
def is_borrowed(image: _Image) -> bool: ...
def defaults(function: str) -> dict[str, Any]: ...
