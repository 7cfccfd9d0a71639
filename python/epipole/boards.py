"""Calibration boards, for ``find_board`` and ``calibrate``. Lengths may be in any unit, which is that of the resulting distances.

>>> epipole.CharucoBoard((7, 5), square=35.0, marker=26.0)
CharucoBoard(size=(7, 5), square=35.0, marker=26.0, dictionary='5x5_100')
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A chessboard."""

    size: tuple[int, int] | None = None
    """Columns and rows of inner corners; None for any size."""
    square: float = 1.0
    """Side of a square."""


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A chessboard with a marker in every white square."""

    size: tuple[int, int]
    """Columns and rows of squares."""
    square: float
    """Side of a square."""
    marker: float
    """Side of a marker including its black border."""
    dictionary: str = "5x5_100"
    """Marker dictionary: OpenCV's names without DICT_."""


@dataclass(frozen=True, slots=True)
class ArucoGrid:
    """A grid of ArUco markers (OpenCV's GridBoard)."""

    size: tuple[int, int]
    """Columns and rows of markers."""
    marker: float
    """Side of a marker including its black border."""
    spacing: float = 0.3
    """Gap between markers, as a fraction of their side."""
    dictionary: str = "5x5_100"
    """Marker dictionary."""


@dataclass(frozen=True, slots=True)
class AprilGrid:
    """A grid of AprilTags of the family 36h11 with black squares between them (Kalibr's aprilgrid)."""

    size: tuple[int, int]
    """Columns and rows of markers."""
    marker: float
    """Side of a marker including its black border."""
    spacing: float = 0.3
    """Gap between markers, as a fraction of their side."""
