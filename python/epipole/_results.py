"""Results of the functions: frozen dataclasses over arrays."""

from __future__ import annotations

import base64
import os
from dataclasses import dataclass, fields
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from epipole import _native

if TYPE_CHECKING:
    from numpy.typing import NDArray


class _Result:
    """Base of results: a short repr without array contents, and thumbnails of maps in notebooks."""

    __slots__ = ()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._summary()})"

    def _summary(self) -> str:
        raise NotImplementedError

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{f.name}</td><td>{_cell_html(getattr(self, f.name))}</td></tr>" for f in fields(self))
        return f"<table><caption>{type(self).__name__}: {self._summary()}</caption>{rows}</table>"


def _cell_html(value: Any) -> str:
    if isinstance(value, np.ndarray):
        if value.ndim == 3 and value.shape[2] == 3 and value.dtype in (np.uint8, np.uint16) and min(value.shape[:2]) > 9:
            small = value[:: _step(value), :: _step(value)]
            return _bitmap(small if value.dtype == np.uint8 else (small >> 8).astype(np.uint8))
        if value.ndim == 2 and value.dtype == np.float32 and min(value.shape) > 9:
            return _thumbnail(value)
        return f"{value.dtype} {value.shape}"
    return f"{value}"


def _step(values: NDArray[Any]) -> int:
    return max(1, max(values.shape[:2]) // 240)


def _thumbnail(values: NDArray[np.float32]) -> str:
    """Renders a float map as a thumbnail: dark is low, invalid is black."""
    small = values[:: _step(values), :: _step(values)]
    known = small[np.isfinite(small)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    gray = np.nan_to_num((small - low) / max(high - low, 1e-12) * 223 + 32, nan=0.0, posinf=0.0, neginf=0.0)
    gray = np.clip(gray, 0, 255).astype(np.uint8)
    return f"{_bitmap(np.repeat(gray[..., None], 3, axis=2))} {low:.4g} to {high:.4g}"


def _bitmap(rgb: NDArray[np.uint8]) -> str:
    """Encodes a small image as an uncompressed BMP: rows bottom-up, each padded to a multiple of four bytes."""
    height, width = rgb.shape[:2]
    row = (3 * width + 3) // 4 * 4
    data = np.zeros((height, row), np.uint8)
    data[:, : 3 * width] = rgb[::-1, :, ::-1].reshape(height, 3 * width)
    header = b"BM" + (54 + data.size).to_bytes(4, "little") + bytes(4) + (54).to_bytes(4, "little")
    header += (40).to_bytes(4, "little") + width.to_bytes(4, "little") + height.to_bytes(4, "little")
    header += (1).to_bytes(2, "little") + (24).to_bytes(2, "little") + bytes(24)
    text = base64.b64encode(header + data.tobytes()).decode()
    return f'<img src="data:image/bmp;base64,{text}">'


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Depth(_Result):
    """Disparity, and depth if the geometry is known. All maps have the size of the left image; invalid is NaN."""

    disparity: NDArray[np.float32]
    """float32, px: x in the left image minus x in the right one."""
    state: NDArray[np.uint8]
    """uint8: 0 matched, 1 occluded, 2 mismatched, 3 out of view; 1 to 3 are filled from their surroundings; 4 black border without data."""
    disparity_deviation: NDArray[np.float32]
    """float32, px: standard deviation, NaN where unknown."""
    depth: NDArray[np.float32] | None
    """float32, in the unit of the baseline."""
    depth_deviation: NDArray[np.float32] | None
    """float32: standard deviation, NaN where unknown."""
    confidence: NDArray[np.float32] | None
    """float32, 0 to 1; with ``confidence=True``."""
    Q: NDArray[np.float64] | None
    """float64 (4, 4): maps (x, y, disparity, 1) to homogeneous (X, Y, Z, W), as in OpenCV's reprojectImageTo3D."""
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None
    """With ``rig``: both rectified images, uint8; the maps belong to the first."""
    cloud: PointCloud | None
    """With ``cloud=True``: the colored points; with ``rig`` in the frame of its left camera."""
    few_matches: tuple[int, int] | None
    """For a poorly matched pair that was not refused: number of features with a consistent disparity, and number of features; else None."""
    vertical_offset: tuple[float, float, float, float, float, float] | None
    """Corrected vertical disparity in px, a quadratic function of the position: the coefficients of 1, x, y, x², xy and y², with x and y relative to the center of the right image, in widths and heights; None if none was corrected."""
    disparities: tuple[int, int]
    """Smallest disparity of the search range, and its size."""
    valid_fraction: float
    """Fraction of the pixels with data that have a disparity."""
    matched_fraction: float
    """Fraction of the pixels with data that were matched and passed the consistency checks."""
    seconds: dict[str, float]
    """Run time by stage."""

    @property
    def matched(self) -> NDArray[np.bool_]:
        """bool: the pixels that were matched and passed the consistency checks."""
        return self.state == 0

    def _summary(self) -> str:
        height, width = self.disparity.shape
        kind = "disparity and depth" if self.depth is not None else "disparity"
        return f"{width}×{height} px, {kind}, {100 * self.matched_fraction:.1f} % matched"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Matches(_Result):
    """Tentative matches between two photographs."""

    points: NDArray[np.float64]
    """float64 (n, 4): x1, y1, x2, y2 in px."""
    indices: NDArray[np.uint32]
    """uint32 (n, 2): indices of the two keypoints."""
    ratios: NDArray[np.float32]
    """float32 (n,): ratio of the best to the second best descriptor distance, 0 (distinctive) to 1 (ambiguous)."""
    keypoints: tuple[NDArray[np.float32], NDArray[np.float32]]
    """For each image, float32 (m, 5): x, y, scale, angle, response."""
    seconds: dict[str, float]
    """Run time by stage."""

    def __len__(self) -> int:
        return len(self.points)

    def _summary(self) -> str:
        return f"{len(self)} matches between {len(self.keypoints[0])} and {len(self.keypoints[1])} keypoints"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Model(_Result):
    """A homography or fundamental matrix, and its inliers."""

    model: NDArray[np.float64]
    """float64 (3, 3)."""
    inliers: NDArray[np.bool_]
    """bool (n,)."""
    rms: float
    """RMS residual of the inliers, px."""
    iterations: int
    """Number of RANSAC samples."""
    log10_false_alarms: float | None
    """log10 of the number of false alarms: expected number of equally supported models if all matches were wrong; lower is more reliable."""
    seconds: dict[str, float]
    """Run time by stage."""

    def _summary(self) -> str:
        return f"{int(self.inliers.sum())} of {len(self.inliers)} matches, {self.rms:.3f} px RMS"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EssentialModel(Model):
    """An essential matrix and the pose of the second view: x2 = R x1 + t."""

    rotation: NDArray[np.float64]
    """float64 (3, 3)."""
    translation: NDArray[np.float64]
    """float64 (3,), of unit length."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PoseModel(_Result):
    """The absolute pose of a camera, x = R X + t, and its inliers."""

    rotation: NDArray[np.float64]
    """float64 (3, 3): R."""
    translation: NDArray[np.float64]
    """float64 (3,): t."""
    inliers: NDArray[np.bool_]
    """bool (n,)."""
    rms: float
    """RMS reprojection error of the inliers, px."""
    iterations: int
    """Number of RANSAC samples."""
    log10_false_alarms: float | None
    """log10 of the number of false alarms: expected number of equally supported poses if all matches were wrong; lower is more reliable."""
    seconds: dict[str, float]
    """Run time by stage."""

    @property
    def center(self) -> NDArray[np.float64]:
        """float64 (3,): camera center in world coordinates."""
        return -self.rotation.T @ self.translation

    def _summary(self) -> str:
        return f"{int(self.inliers.sum())} of {len(self.inliers)} points, {self.rms:.3f} px RMS"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Features(_Result):
    """Keypoints of an image and their descriptors."""

    keypoints: NDArray[np.float32]
    """float32 (n, 5): x, y, scale, angle, response."""
    descriptors: NDArray[np.float32]
    """float32 (n, dimension)."""
    kind: str = "foreign"
    """Kind of descriptor; ``foreign`` for features of other programs."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def _summary(self) -> str:
        return f"{len(self)} of dimension {self.descriptors.shape[1]}, {self.kind}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PointCloud(_Result):
    """3D points."""

    positions: NDArray[np.float32]
    """float32 (n, 3)."""
    colors: NDArray[np.uint8] | None = None
    """uint8 (n, 3), RGB."""
    normals: NDArray[np.float32] | None = None
    """float32 (n, 3), of unit length."""

    def __len__(self) -> int:
        return len(self.positions)

    def write(self, path: str | PathLike[str]) -> None:
        """Writes a binary PLY."""
        _native.write_cloud(path, self.positions, self.colors, self.normals)

    def _summary(self) -> str:
        return f"{len(self)} points"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rectified(_Result):
    """A rectified pair: corresponding points lie in the same row."""

    left: NDArray[Any]
    """In the type of the input."""
    right: NDArray[Any]
    """The right image, likewise."""
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    """bool: where each shows anything."""
    camera: _native.Camera
    """Camera of both rectified images."""
    rotations: tuple[NDArray[np.float64], NDArray[np.float64]]
    """For each camera, float64 (3, 3): rotation from its frame to the rectified one."""
    Q: NDArray[np.float64]
    """float64 (4, 4): maps (x, y, disparity, 1) to homogeneous (X, Y, Z, W)."""
    baseline: float
    """In the unit of the rig."""
    vertical: bool
    """Whether the rig is vertical: the images are then rotated by 90 degrees."""
    vertical_px: tuple[float, float] | None
    """Median and 95 % quantile of the absolute vertical disparity of feature matches; None if there are too few."""
    seconds: dict[str, float]
    """Run time by stage."""

    def _summary(self) -> str:
        rows = "" if self.vertical_px is None else f", vertical residual {self.vertical_px[0]:.2f} px"
        return f"{self.camera.width}×{self.camera.height} px, focal {self.camera.matrix[0, 0]:.2f} px{rows}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BoardView(_Result):
    """The detected points of a calibration board."""

    pixels: NDArray[np.float64]
    """float64 (n, 2): image positions, px."""
    points: NDArray[np.float64]
    """float64 (n, 2): positions on the board, x right and y down."""
    ids: NDArray[np.int64]
    """int64 (n,): ids on the board."""
    deviations: NDArray[np.float64]
    """float64 (n,): standard deviation of a coordinate, px."""
    size: tuple[int, int]
    """Columns and rows of the board."""

    def __len__(self) -> int:
        return len(self.pixels)

    def _summary(self) -> str:
        return f"{len(self)} points of a board of {self.size[0]}×{self.size[1]}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Calibration(_Result):
    """Calibrated cameras, with their uncertainty."""

    cameras: tuple[_native.Camera, ...]
    """The cameras."""
    places: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]
    """For each camera (R, t): from the first camera's frame to its own, in the unit of the board."""
    rig: _native.Rig | None
    """The first two cameras as a stereo rig."""
    rms: float
    """RMS reprojection error of all inlier corners, px."""
    holdout_rms: float
    """The same on held-out views."""
    holdout_all_rms: float
    """The same including outlier corners, for comparison with programs that reject none."""
    camera_rms: NDArray[np.float64]
    """By camera."""
    camera_holdout_rms: NDArray[np.float64]
    """By camera."""
    noise: float
    """Standard deviation of a coordinate of a corner, px."""
    rectified_dy: tuple[float, float] | None
    """For a rig: mean and largest absolute vertical disparity of corners after rectification, px."""
    parameter_names: tuple[str, ...]
    """Such as ``camera0.fx`` and ``board.kx``."""
    parameters: NDArray[np.float64]
    """float64 (n,)."""
    deviations: NDArray[np.float64]
    """float64 (n,): their standard deviations."""
    covariance: NDArray[np.float64]
    """float64 (n, n)."""
    board_size: tuple[int, int]
    """Columns and rows of the detected board."""
    board_deflection: tuple[float, float]
    """Deflection of the board along x and y, in its unit."""
    poses: tuple[tuple[NDArray[np.float64], NDArray[np.float64]] | None, ...]
    """By view (R, t): from the board's frame to the first camera's; None if no photograph of the view was used."""
    refused: tuple[tuple[dict[str, Any] | None, ...], ...]
    """By view and camera: why the photograph was rejected; None if it was used."""
    trust: str
    """good, usable or poor."""
    notes: tuple[dict[str, Any], ...]
    """Deficiencies, the worst first: each with its ``kind`` and numbers."""
    seconds: dict[str, float]
    """Run time by stage."""

    @property
    def camera(self) -> _native.Camera:
        """The camera, or the first one."""
        return self.cameras[0]

    def _summary(self) -> str:
        used = sum(any(reason is None for reason in view) for view in self.refused)
        return (
            f"{len(self.cameras)} camera{'s' if len(self.cameras) > 1 else ''} from {used} of {len(self.refused)} views, "
            f"{self.rms:.3f} px RMS, {self.holdout_rms:.3f} px on held-out views, {self.trust}"
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ModelImage(_Result):
    """A registered image of a model."""

    name: str
    camera: int
    """Key of its camera."""
    rotation: NDArray[np.float64]
    """float64 (3, 3): R of x = R X + t, world to camera."""
    translation: NDArray[np.float64]
    """float64 (3,): t."""
    keypoints: NDArray[np.float64]
    """float64 (n, 2), px."""
    point_ids: NDArray[np.int64]
    """int64 (n,): the point observed by each keypoint, -1 for none."""

    @property
    def center(self) -> NDArray[np.float64]:
        """float64 (3,): camera center in world coordinates."""
        return -self.rotation.T @ self.translation

    def _summary(self) -> str:
        return f"{self.name}, {int((self.point_ids >= 0).sum())} points, {len(self.keypoints)} keypoints"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Reconstruction(_Result):
    """A sparse model as in COLMAP: cameras, images with poses, and points with tracks."""

    cameras: dict[int, _native.Camera]
    """By id."""
    images: dict[int, ModelImage]
    """By id."""
    points: NDArray[np.float64]
    """float64 (n, 3)."""
    colors: NDArray[np.uint8]
    """uint8 (n, 3), RGB."""
    errors: NDArray[np.float64]
    """float64 (n,): mean reprojection error, px; negative if unknown."""
    point_ids: NDArray[np.int64]
    """int64 (n,)."""

    def __len__(self) -> int:
        return len(self.images)

    @staticmethod
    def read(folder: str | PathLike[str]) -> Reconstruction:
        """Reads COLMAP's files, text or binary."""
        return _native.read_model(folder)

    def write(self, folder: str | PathLike[str], *, format: Literal["colmap-text", "colmap-binary"] = "colmap-text") -> None:
        """Writes COLMAP's files, ``colmap-text`` or ``colmap-binary``, replacing an existing model. Creates the folder."""
        os.makedirs(folder, exist_ok=True)
        _native.write_model(folder, self, format=format)

    @staticmethod
    def from_pycolmap(reconstruction: Any) -> Reconstruction:
        """Converts from pycolmap's class. Pixel centers are at +0.5 there and at integer coordinates here."""
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            reconstruction.write_binary(folder)
            return _native.read_model(folder)

    def to_pycolmap(self) -> Any:
        """Converts to pycolmap's class, which must be installed."""
        import tempfile

        import pycolmap

        with tempfile.TemporaryDirectory() as folder:
            self.write(folder, format="colmap-binary")
            return pycolmap.Reconstruction(folder)

    @property
    def cloud(self) -> PointCloud:
        """The points as a point cloud."""
        return PointCloud(self.points.astype(np.float32), self.colors)

    def _summary(self) -> str:
        seen = sum(int((image.point_ids >= 0).sum()) for image in self.images.values())
        length = seen / max(len(self.points), 1)
        return f"{len(self.images)} photographs, {len(self.points)} points, mean track length {length:.1f}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SfmResult(_Result):
    """Result of structure from motion."""

    models: tuple[Reconstruction, ...]
    """Reconstructions, the one with the most images first. Unless georeferenced, they have no common frame."""
    solvers: tuple[str, ...]
    """Solver of each."""
    frames: tuple[str, ...]
    """Frame of each: given ``centers``, ``gps`` positions (meters; X east, Y north, Z up), ``distances`` (Z up, in their unit), ``upright`` (Z up, arbitrary unit), or
    ``any``."""
    left_out: dict[str, dict[str, Any]]
    """By name: why a photograph is not registered."""
    pairs: int
    """Number of verified image pairs."""
    refused_pairs: int
    """Number of these that were refused: inconsistent with other pairs, or repeated structure."""
    seconds: dict[str, float]
    """Run time by stage."""

    @property
    def model(self) -> Reconstruction:
        """The largest model."""
        return self.models[0]

    def _summary(self) -> str:
        more = f"; {len(self.models) - 1} more models" if len(self.models) > 1 else ""
        return f"{self.model._summary()}{more}; {len(self.left_out)} photographs left out"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TwoViewReconstruction(_Result):
    """Result of a two-view reconstruction, in the first camera's frame; the unit is the baseline."""

    reconstruction: Reconstruction
    """Cameras, poses, points."""
    rotation: NDArray[np.float64]
    """float64 (3, 3): R of x2 = R x1 + t."""
    translation: NDArray[np.float64]
    """float64 (3,), of unit length."""
    rms: float
    """RMS reprojection error, px."""
    median_angle: float
    """Median triangulation angle, radians."""
    pose_deviation: tuple[float, float]
    """Standard deviations of the rotation and of the translation direction, radians."""
    focal_deviation: float
    """Relative standard deviation of the focal length; 0 for given cameras."""
    focal_is_doubtful: bool
    """Whether the focal length is so uncertain that the depth of the scene may be stretched."""
    matches: int
    """Number of tentative matches."""
    inliers: int
    """Number of inliers of the relative pose."""
    dense: PointCloud | None
    """With ``dense=True``."""
    seconds: dict[str, float]
    """Run time by stage."""

    @property
    def points(self) -> NDArray[np.float64]:
        """float64 (n, 3)."""
        return self.reconstruction.points

    @property
    def cameras(self) -> tuple[_native.Camera, ...]:
        """Both cameras."""
        return tuple(self.reconstruction.cameras[image.camera] for image in self.reconstruction.images.values())

    def _summary(self) -> str:
        return f"{len(self.points)} points, {self.rms:.3f} px RMS, {self.inliers} of {self.matches} matches are inliers"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Panorama(_Result):
    """A stitched panorama."""

    image: NDArray[np.uint8] | NDArray[np.uint16]
    """(height, width, 3), uint8, or uint16 if a photograph has 16 bits; black where no photograph reaches."""
    mask: NDArray[np.bool_]
    """bool: pixels covered by a photograph."""
    labels: NDArray[np.uint16]
    """uint16: index of the source photograph of each pixel, 65535 for none."""
    views: dict[int, tuple[_native.Camera, NDArray[np.float64]]]
    """For each registered photograph (Camera, R): rotation from the world frame to the camera frame."""
    gains: NDArray[np.float32]
    """float32 (n, 3): gains of the red, green and blue channel of each photograph."""
    left_out: dict[int, dict[str, Any]]
    """By index: why a photograph is not registered."""
    registration: str
    """The registration as JSON: for `panorama(registration=...)` with other photographs of the same views, or as a file for `cv panorama --registration`."""
    stacks: list[list[int]]
    """Exposure brackets: indices of photographs of one view with different exposures."""
    rms: float
    """RMS residual of the matches, px of the photographs."""
    shows_parallax: bool
    """Whether the photographs have parallax (different camera centers): near objects may be misaligned at the seams."""
    seconds: dict[str, float]
    """Run time by stage."""

    def _summary(self) -> str:
        height, width = self.mask.shape
        return f"{width}×{height} px of {len(self.views)} photographs, {self.rms:.2f} px RMS, {len(self.left_out)} left out"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Object(_Result):
    """A region of the object's color."""

    found: bool
    """Whether it is accepted as the object."""
    score: float | None
    """0 to 1: agreement of color and shape with the training objects."""
    center: tuple[float, float]
    """x and y, px."""
    area: int
    """Pixels."""
    axes: tuple[float, float]
    """Semi-axes of the ellipse of the same moments, px."""
    angle: float
    """Angle of the major axis, radians clockwise from the x axis."""
    box: tuple[int, int, int, int]
    """Left, top, width, height, px."""
    truncated: bool
    """Whether it touches the image border."""

    def _summary(self) -> str:
        found = "found" if self.found else "not found"
        return f"{found} at {self.center[0]:.1f}, {self.center[1]:.1f}, {self.area} px"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Located(_Result):
    """Detections of an object in an image."""

    mask: NDArray[np.bool_]
    """bool: the pixels of the accepted objects."""
    objects: tuple[Object, ...]
    """All regions of its color, the best first."""
    seconds: dict[str, float]
    """Run time by stage."""

    def _summary(self) -> str:
        return f"{sum(o.found for o in self.objects)} found among {len(self.objects)} regions"
