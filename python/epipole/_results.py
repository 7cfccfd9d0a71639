"""What the functions give back: frozen dataclasses over arrays."""

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
    """Pictures of maps in notebooks, and a text without the arrays' numbers."""

    __slots__ = ()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._words()})"

    def _words(self) -> str:
        raise NotImplementedError

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{f.name}</td><td>{_told(getattr(self, f.name))}</td></tr>" for f in fields(self))
        return f"<table><caption>{type(self).__name__}: {self._words()}</caption>{rows}</table>"


def _told(value: Any) -> str:
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
    """A map of floats as a small picture: dark is low, unknown is black."""
    small = values[:: _step(values), :: _step(values)]
    known = small[np.isfinite(small)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    gray = np.nan_to_num((small - low) / max(high - low, 1e-12) * 223 + 32, nan=0.0, posinf=0.0, neginf=0.0)
    gray = np.clip(gray, 0, 255).astype(np.uint8)
    return f"{_bitmap(np.repeat(gray[..., None], 3, axis=2))} {low:.4g} to {high:.4g}"


def _bitmap(rgb: NDArray[np.uint8]) -> str:
    """A small picture, without a library for it: an uncompressed bitmap, rows from the bottom up, each a multiple of four bytes long."""
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
    """Disparity, and depth where the geometry is known. All maps have the left photograph's size; unknown is NaN."""

    disparity: NDArray[np.float32]
    """float32, px: x of the left photograph minus x of the right one."""
    state: NDArray[np.uint8]
    """uint8: 0 matched, 1 occluded, 2 mismatched, 3 out of view; all but 0 are filled in from around."""
    disparity_deviation: NDArray[np.float32]
    """float32, px: standard deviation, NaN where unknown."""
    depth: NDArray[np.float32] | None
    """float32, in the unit of the baseline."""
    depth_deviation: NDArray[np.float32] | None
    """float32: standard deviation, NaN where unknown."""
    confidence: NDArray[np.float32] | None
    """float32, 0 to 1; with ``confidence=True``."""
    Q: NDArray[np.float64] | None
    """float64 (4, 4): makes (X, Y, Z, W) of (x, y, disparity, 1), as OpenCV's reprojectImageTo3D takes it."""
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None
    """With ``rig``: both photographs rectified, uint8; the maps are of the first."""
    cloud: PointCloud | None
    """With ``cloud=True``: the colored points; of a rig in the frame of its left camera."""
    few_matches: tuple[int, int] | None
    """Where so little is matched that the pair was nearly refused: features that show the same disparity, of how many."""
    vertical_offset: tuple[float, float, float] | None
    """Where the rows of the pair were apart and have been aligned, in px: in the middle, more at the right border than at the left, more at the bottom than at the top."""
    disparities: tuple[int, int]
    """Smallest disparity tried, and how many."""
    valid_fraction: float
    """Share of the pixels with a disparity."""
    matched_fraction: float
    """Share of the pixels that were matched and confirmed."""
    seconds: dict[str, float]
    """By stage."""

    @property
    def matched(self) -> NDArray[np.bool_]:
        """bool: the pixels that were matched and confirmed."""
        return self.state == 0

    def _words(self) -> str:
        height, width = self.disparity.shape
        kind = "disparity and depth" if self.depth is not None else "disparity"
        return f"{width}×{height} px, {kind}, {100 * self.matched_fraction:.1f} % matched"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Matches(_Result):
    """Tentative matches between two photographs."""

    points: NDArray[np.float64]
    """float64 (n, 4): x1, y1, x2, y2 in px."""
    indices: NDArray[np.uint32]
    """uint32 (n, 2): rows of the two keypoints."""
    ratios: NDArray[np.float32]
    """float32 (n,): distance over that of the second best, 0 (sure) to 1 (ambiguous)."""
    keypoints: tuple[NDArray[np.float32], NDArray[np.float32]]
    """Of each photograph, float32 (m, 5): x, y, scale, angle, response."""
    seconds: dict[str, float]
    """By stage."""

    def __len__(self) -> int:
        return len(self.points)

    def _words(self) -> str:
        return f"{len(self)} matches between {len(self.keypoints[0])} and {len(self.keypoints[1])} keypoints"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Model(_Result):
    """A homography or fundamental matrix, and the matches that fit it."""

    model: NDArray[np.float64]
    """float64 (3, 3)."""
    inliers: NDArray[np.bool_]
    """bool (n,)."""
    rms: float
    """Root mean square residual of the inliers, px."""
    iterations: int
    """Samples drawn."""
    log10_false_alarms: float | None
    """Of models as well supported to be expected of wrong matches; lower is surer."""
    seconds: dict[str, float]
    """By stage."""

    def _words(self) -> str:
        return f"{int(self.inliers.sum())} of {len(self.inliers)} matches, {self.rms:.3f} px RMS"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EssentialModel(Model):
    """An essential matrix and the pose of the second view: x2 = R x1 + t."""

    rotation: NDArray[np.float64]
    """float64 (3, 3)."""
    translation: NDArray[np.float64]
    """float64 (3,), of length 1."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PoseModel(_Result):
    """The pose of a camera, x = R X + t, and the points that fit it."""

    rotation: NDArray[np.float64]
    """float64 (3, 3): R."""
    translation: NDArray[np.float64]
    """float64 (3,): t."""
    inliers: NDArray[np.bool_]
    """bool (n,)."""
    rms: float
    """Root mean square reprojection error of the inliers, px."""
    iterations: int
    """Samples drawn."""
    log10_false_alarms: float | None
    """Of poses as well supported to be expected of wrong matches; lower is surer."""
    seconds: dict[str, float]
    """By stage."""

    @property
    def center(self) -> NDArray[np.float64]:
        """float64 (3,): where the camera stands."""
        return -self.rotation.T @ self.translation

    def _words(self) -> str:
        return f"{int(self.inliers.sum())} of {len(self.inliers)} points, {self.rms:.3f} px RMS"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Features(_Result):
    """Keypoints of a photograph and their descriptors."""

    keypoints: NDArray[np.float32]
    """float32 (n, 5): x, y, scale, angle, response."""
    descriptors: NDArray[np.float32]
    """float32 (n, numbers)."""
    kind: str = "foreign"
    """What the numbers of a descriptor mean; features of other programs are ``foreign``."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def _words(self) -> str:
        return f"{len(self)} of {self.descriptors.shape[1]} numbers, {self.kind}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PointCloud(_Result):
    """Points in space."""

    positions: NDArray[np.float32]
    """float32 (n, 3)."""
    colors: NDArray[np.uint8] | None = None
    """uint8 (n, 3), RGB."""
    normals: NDArray[np.float32] | None = None
    """float32 (n, 3), of length 1."""

    def __len__(self) -> int:
        return len(self.positions)

    def write(self, path: str | PathLike[str]) -> None:
        """Writes a binary PLY."""
        _native.write_cloud(path, self.positions, self.colors, self.normals)

    def _words(self) -> str:
        return f"{len(self)} points"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rectified(_Result):
    """Both photographs of a rig with the same points in the same rows."""

    left: NDArray[Any]
    """In the type it came in."""
    right: NDArray[Any]
    """The same of the right photograph."""
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    """bool: where each shows anything."""
    camera: _native.Camera
    """Of both rectified photographs."""
    rotations: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Of each camera: its frame to the rectified one, float64 (3, 3)."""
    Q: NDArray[np.float64]
    """float64 (4, 4): makes (X, Y, Z, W) of (x, y, disparity, 1)."""
    baseline: float
    """In the unit of the rig."""
    vertical: bool
    """Whether one camera stands above the other: the photographs are turned by a quarter then."""
    vertical_px: tuple[float, float] | None
    """Median and 95 % quantile of the difference in rows of features found in both; None where there are too few."""
    seconds: dict[str, float]
    """By stage."""

    def _words(self) -> str:
        rows = "" if self.vertical_px is None else f", rows {self.vertical_px[0]:.2f} px apart"
        return f"{self.camera.width}×{self.camera.height} px, focal {self.camera.matrix[0, 0]:.2f} px{rows}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BoardView(_Result):
    """The points of a calibration board on a photograph."""

    pixels: NDArray[np.float64]
    """float64 (n, 2): where they are seen."""
    points: NDArray[np.float64]
    """float64 (n, 2): where they are on the board, x right and y down."""
    ids: NDArray[np.int64]
    """int64 (n,): their numbers on the board."""
    deviations: NDArray[np.float64]
    """float64 (n,): standard deviation of a coordinate, px."""
    size: tuple[int, int]
    """Columns and rows of the board."""

    def __len__(self) -> int:
        return len(self.pixels)

    def _words(self) -> str:
        return f"{len(self)} points of a board of {self.size[0]}×{self.size[1]}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Calibration(_Result):
    """Calibrated cameras, and how far they can be trusted."""

    cameras: tuple[_native.Camera, ...]
    """The cameras."""
    places: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]
    """Of each camera (R, t): the first camera's frame to its own, in the unit of the board."""
    rig: _native.Rig | None
    """The first two cameras."""
    rms: float
    """Root mean square distance of all corners used, px."""
    holdout_rms: float
    """The same on views that had no part in the fit."""
    holdout_all_rms: float
    """The same over all their corners, those left out as outliers as well: beside a program that leaves out none."""
    camera_rms: NDArray[np.float64]
    """By camera."""
    camera_holdout_rms: NDArray[np.float64]
    """By camera."""
    noise: float
    """Standard deviation of a coordinate of a corner, px."""
    rectified_dy: tuple[float, float] | None
    """Of a rig: mean and largest difference of the rows of one corner in both rectified photographs, px."""
    parameter_names: tuple[str, ...]
    """Such as ``camera0.fx`` and ``board.kx``."""
    parameters: NDArray[np.float64]
    """float64 (n,)."""
    deviations: NDArray[np.float64]
    """float64 (n,): their standard deviations."""
    covariance: NDArray[np.float64]
    """float64 (n, n)."""
    board_size: tuple[int, int]
    """Columns and rows of the board that was seen."""
    board_deflection: tuple[float, float]
    """By how much the board is bent along x and y, in its unit."""
    poses: tuple[tuple[NDArray[np.float64], NDArray[np.float64]] | None, ...]
    """By view (R, t): the board's frame to the first camera's; None where no photograph of the view was used."""
    refused: tuple[tuple[dict[str, Any] | None, ...], ...]
    """By view and camera: why the photograph was not used; None where it was."""
    trust: str
    """good, usable or poor."""
    notes: tuple[dict[str, Any], ...]
    """What to know, the worst first: each with its ``kind`` and numbers."""
    seconds: dict[str, float]
    """By stage."""

    @property
    def camera(self) -> _native.Camera:
        """The camera, or the first one."""
        return self.cameras[0]

    def _words(self) -> str:
        used = sum(any(reason is None for reason in view) for view in self.refused)
        return (
            f"{len(self.cameras)} camera{'s' if len(self.cameras) > 1 else ''} from {used} of {len(self.refused)} views, "
            f"{self.rms:.3f} px RMS, {self.holdout_rms:.3f} px on views left out, {self.trust}"
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ModelImage(_Result):
    """A photograph of a model."""

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
    """int64 (n,): the point that each keypoint is of, -1 for none."""

    @property
    def center(self) -> NDArray[np.float64]:
        """float64 (3,): where the camera stands."""
        return -self.rotation.T @ self.translation

    def _words(self) -> str:
        return f"{self.name}, {int((self.point_ids >= 0).sum())} points of {len(self.keypoints)} keypoints"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Reconstruction(_Result):
    """Cameras, photographs with their poses, and points: a sparse model, as COLMAP has it."""

    cameras: dict[int, _native.Camera]
    """By number."""
    images: dict[int, ModelImage]
    """By number."""
    points: NDArray[np.float64]
    """float64 (n, 3)."""
    colors: NDArray[np.uint8]
    """uint8 (n, 3), RGB."""
    errors: NDArray[np.float64]
    """float64 (n,): mean reprojection error, px; negative where it is not known."""
    point_ids: NDArray[np.int64]
    """int64 (n,)."""

    def __len__(self) -> int:
        return len(self.images)

    @staticmethod
    def read(folder: str | PathLike[str]) -> Reconstruction:
        """Reads COLMAP's files, text or binary."""
        return _native.read_model(folder)

    def write(self, folder: str | PathLike[str], *, format: Literal["colmap-text", "colmap-binary"] = "colmap-text") -> None:
        """Writes COLMAP's files, in place of a model that is there: ``colmap-text`` or ``colmap-binary``. The folder is made."""
        os.makedirs(folder, exist_ok=True)
        _native.write_model(folder, self, format=format)

    @staticmethod
    def from_pycolmap(reconstruction: Any) -> Reconstruction:
        """The same model of pycolmap's class. Its pixels have their centers at +0.5; here they have them at whole numbers."""
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            reconstruction.write_binary(folder)
            return _native.read_model(folder)

    def to_pycolmap(self) -> Any:
        """The same model as pycolmap's class, which must be installed."""
        import tempfile

        import pycolmap

        with tempfile.TemporaryDirectory() as folder:
            self.write(folder, format="colmap-binary")
            return pycolmap.Reconstruction(folder)

    @property
    def cloud(self) -> PointCloud:
        """The points as a cloud."""
        return PointCloud(self.points.astype(np.float32), self.colors)

    def _words(self) -> str:
        seen = sum(int((image.point_ids >= 0).sum()) for image in self.images.values())
        length = seen / max(len(self.points), 1)
        return f"{len(self.images)} photographs, {len(self.points)} points seen {length:.1f} times each"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SfmResult(_Result):
    """What many photographs show."""

    models: tuple[Reconstruction, ...]
    """Reconstructions, the one of most photographs first. Their places to each other are not known."""
    solvers: tuple[str, ...]
    """How each was found."""
    frames: tuple[str, ...]
    """What each was brought to: ``centers`` that were given, ``gps`` positions (meters; X east, Y north, Z up), ``distances`` (Z up, in their unit), ``upright`` (Z up, its unit arbitrary), or
    ``any``."""
    left_out: dict[str, dict[str, Any]]
    """By name, why a photograph is in no model."""
    pairs: int
    """Pairs of photographs that hold."""
    refused_pairs: int
    """Those of them that were not used: they contradict others, or show different things that look alike."""
    seconds: dict[str, float]
    """By stage."""

    @property
    def model(self) -> Reconstruction:
        """The largest model."""
        return self.models[0]

    def _words(self) -> str:
        more = f"; {len(self.models) - 1} more models" if len(self.models) > 1 else ""
        return f"{self.model._words()}{more}; {len(self.left_out)} photographs left out"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TwoViewReconstruction(_Result):
    """What two photographs show, in the first camera's frame; the unit is the distance between the cameras."""

    reconstruction: Reconstruction
    """Cameras, poses, points."""
    rotation: NDArray[np.float64]
    """float64 (3, 3): R of x2 = R x1 + t."""
    translation: NDArray[np.float64]
    """float64 (3,), of length 1."""
    rms: float
    """Root mean square reprojection error, px."""
    median_angle: float
    """Between the two rays of a point, radians."""
    pose_deviation: tuple[float, float]
    """Standard deviations of rotation and of the direction of the translation, radians."""
    focal_deviation: float
    """Relative standard deviation of the focal length; 0 where the cameras were given."""
    focal_is_doubtful: bool
    """Whether the depth of the scene may be stretched, since the focal length is hardly known."""
    matches: int
    """Tentative matches."""
    inliers: int
    """Those of them that agree with the motion."""
    dense: PointCloud | None
    """With ``dense=True``."""
    seconds: dict[str, float]
    """By stage."""

    @property
    def points(self) -> NDArray[np.float64]:
        """float64 (n, 3)."""
        return self.reconstruction.points

    @property
    def cameras(self) -> tuple[_native.Camera, ...]:
        """Both cameras."""
        return tuple(self.reconstruction.cameras[image.camera] for image in self.reconstruction.images.values())

    def _words(self) -> str:
        return f"{len(self.points)} points, {self.rms:.3f} px RMS, {self.inliers} of {self.matches} matches agree"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Panorama(_Result):
    """Photographs joined to one picture."""

    image: NDArray[np.uint8] | NDArray[np.uint16]
    """(height, width, 3), uint8, or uint16 where a photograph has 16 bits; black where no photograph reaches."""
    mask: NDArray[np.bool_]
    """bool: where one does."""
    labels: NDArray[np.uint16]
    """uint16: which photograph each pixel is from, 65535 for none."""
    views: dict[int, tuple[_native.Camera, NDArray[np.float64]]]
    """Of each photograph that is used (Camera, R): the world's frame to the camera's."""
    gains: NDArray[np.float32]
    """float32 (n, 3): what red, green and blue of each photograph were multiplied with."""
    left_out: dict[int, dict[str, Any]]
    """By index, why a photograph is not used."""
    registration: str
    """Where the photographs look, as JSON: for `panorama(registration=...)` of others of the same views, or a file for `cv panorama --registration`."""
    rms: float
    """Root mean square distance of the matches, px of the photographs."""
    shows_parallax: bool
    """Whether the photographs were taken from different places: what is near may be cut in two."""
    seconds: dict[str, float]
    """By stage."""

    def _words(self) -> str:
        height, width = self.mask.shape
        return f"{width}×{height} px of {len(self.views)} photographs, {self.rms:.2f} px RMS, {len(self.left_out)} left out"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Object(_Result):
    """A region of a photograph in the object's color."""

    found: bool
    """Whether it is the object."""
    score: float | None
    """0 to 1: how well color and shape agree with the objects that were trained on."""
    center: tuple[float, float]
    """x and y, px."""
    area: int
    """Pixels."""
    axes: tuple[float, float]
    """Semi-axes of the ellipse with its moments, px."""
    angle: float
    """Of the major axis, radians, from right towards down."""
    box: tuple[int, int, int, int]
    """Left, top, width, height, px."""
    truncated: bool
    """Whether it touches the border."""

    def _words(self) -> str:
        found = "found" if self.found else "not found"
        return f"{found} at {self.center[0]:.1f}, {self.center[1]:.1f}, {self.area} px"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Located(_Result):
    """Where an object is in a photograph."""

    mask: NDArray[np.bool_]
    """bool: the pixels of the objects that were found."""
    objects: tuple[Object, ...]
    """All regions in its color, the best first."""
    seconds: dict[str, float]
    """By stage."""

    def _words(self) -> str:
        return f"{sum(o.found for o in self.objects)} found among {len(self.objects)} regions"
