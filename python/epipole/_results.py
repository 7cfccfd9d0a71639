"""What the functions give back: frozen dataclasses over arrays."""

import base64
from dataclasses import dataclass, fields

import numpy as np


class _Result:
    """Pictures of maps in notebooks, and a text without the arrays' numbers."""

    __slots__ = ()

    def __repr__(self):
        return f"{type(self).__name__}({self._words()})"

    def _words(self):
        raise NotImplementedError

    def _repr_html_(self):
        rows = "".join(f"<tr><td>{f.name}</td><td>{_told(getattr(self, f.name))}</td></tr>" for f in fields(self))
        return f"<table><caption>{type(self).__name__}: {self._words()}</caption>{rows}</table>"


def _told(value):
    if isinstance(value, np.ndarray):
        if value.ndim == 2 and value.dtype == np.float32 and min(value.shape) > 9:
            return _thumbnail(value)
        return f"{value.dtype} {value.shape}"
    return f"{value}"


def _thumbnail(values):
    """A map of floats as a small picture: dark is low, unknown is black."""
    step = max(1, max(values.shape) // 240)
    small = values[::step, ::step]
    known = small[np.isfinite(small)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    gray = np.nan_to_num((small - low) / max(high - low, 1e-12) * 223 + 32, nan=0.0, posinf=0.0, neginf=0.0)
    height, width = gray.shape
    # An uncompressed bitmap: rows from the bottom up, each a multiple of four bytes long.
    row = (3 * width + 3) // 4 * 4
    data = np.zeros((height, row), np.uint8)
    data[:, : 3 * width] = np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[::-1], 3, axis=1)
    header = b"BM" + (54 + data.size).to_bytes(4, "little") + bytes(4) + (54).to_bytes(4, "little")
    header += (40).to_bytes(4, "little") + width.to_bytes(4, "little") + height.to_bytes(4, "little")
    header += (1).to_bytes(2, "little") + (24).to_bytes(2, "little") + bytes(24)
    text = base64.b64encode(header + data.tobytes()).decode()
    return f'<img src="data:image/bmp;base64,{text}"> {low:.4g} to {high:.4g}'


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Depth(_Result):
    """Disparity, and depth where the geometry is known. All maps have the left photograph's size; unknown is NaN."""

    disparity: np.ndarray
    """float32, px: x of the left photograph minus x of the right one."""
    state: np.ndarray
    """uint8: 0 matched, 1 occluded, 2 mismatched, 3 out of view; all but 0 are filled in from around."""
    disparity_deviation: np.ndarray
    """float32, px: standard deviation, NaN where filled."""
    depth: "np.ndarray | None"
    """float32, in the unit of the baseline."""
    depth_deviation: "np.ndarray | None"
    """float32: standard deviation, NaN where filled."""
    confidence: "np.ndarray | None"
    """float32, 0 to 1; with ``confidence=True``."""
    disparities: tuple
    """Smallest disparity tried, and how many."""
    valid_fraction: float
    """Share of the pixels with a disparity."""
    matched_fraction: float
    """Share of the pixels that were matched and confirmed."""
    seconds: dict
    """By stage."""

    @property
    def matched(self):
        """bool: the pixels that were matched and confirmed."""
        return self.state == 0

    def _words(self):
        height, width = self.disparity.shape
        kind = "disparity and depth" if self.depth is not None else "disparity"
        return f"{width}×{height} px, {kind}, {100 * self.matched_fraction:.1f} % matched"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Matches(_Result):
    """Tentative matches between two photographs."""

    points: np.ndarray
    """float64 (n, 4): x1, y1, x2, y2 in px."""
    indices: np.ndarray
    """uint32 (n, 2): rows of the two keypoints."""
    ratios: np.ndarray
    """float32 (n,): distance over that of the second best, 0 (sure) to 1 (ambiguous)."""
    keypoints: tuple
    """Of each photograph, float32 (m, 5): x, y, scale, angle, response."""
    seconds: dict
    """By stage."""

    def __len__(self):
        return len(self.points)

    def _words(self):
        return f"{len(self)} matches between {len(self.keypoints[0])} and {len(self.keypoints[1])} keypoints"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Model(_Result):
    """A homography or fundamental matrix, and the matches that fit it."""

    model: np.ndarray
    """float64 (3, 3)."""
    inliers: np.ndarray
    """bool (n,)."""
    rms: float
    """Root mean square residual of the inliers, px."""
    iterations: int
    """Samples drawn."""
    log10_false_alarms: "float | None"
    """Of models as well supported to be expected of wrong matches; lower is surer."""
    seconds: dict
    """By stage."""

    def _words(self):
        return f"{int(self.inliers.sum())} of {len(self.inliers)} matches, {self.rms:.3f} px RMS"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EssentialModel(Model):
    """An essential matrix and the pose of the second view: x2 = R x1 + t."""

    rotation: np.ndarray
    """float64 (3, 3)."""
    translation: np.ndarray
    """float64 (3,), of length 1."""
