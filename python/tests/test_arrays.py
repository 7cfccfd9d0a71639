"""Accepted arrays, arrays used without a copy, and the exceptions of the others."""

import epipole
import numpy as np
import pytest
from epipole import errors


@pytest.mark.parametrize(
    ("change", "borrowed"),
    [
        (lambda p: p, True),
        (lambda p: p[8:-8, 16:-16], True),
        (lambda p: p[::2], True),
        (lambda p: np.ascontiguousarray(p[:, :, 1])[5:, 7:], True),
        (lambda p: (p.astype(np.uint16) * 257)[3:], True),
        (lambda p: (p.astype(np.float32) / 255)[:, 2:], True),
        (lambda p: p[:, :, 1], False),
        (lambda p: p[::-1], False),
        (lambda p: p[:, :, ::-1], False),
        (lambda p: np.asfortranarray(p), False),
    ],
)
def test_layouts_and_types(pair, change, borrowed):
    views = [change(photo) for photo in pair]
    copies = [np.ascontiguousarray(view) for view in views]
    assert epipole.is_borrowed(views[0]) is borrowed and epipole.is_borrowed(copies[0])
    found, expected = (epipole.depth(*photos, disparities=64).disparity for photos in (views, copies))
    assert np.array_equal(found, expected, equal_nan=True)


def test_a_mirrored_pair_is_copied(pair):
    mirrored = [photo[:, ::-1] for photo in reversed(pair)]
    assert not epipole.is_borrowed(mirrored[0])
    assert epipole.depth(*mirrored, disparities=64).matched_fraction > 0.5


def test_read_only_arrays_and_other_libraries_arrays(pair):
    left, right = (photo.copy() for photo in pair)
    left.flags.writeable = False
    expected = epipole.depth(*pair, disparities=64).disparity

    class Array:
        def __array__(self, dtype=None, copy=None):
            return left

    class Tensor:
        def __dlpack__(self, **options):
            return right.__dlpack__(**options)

        def __dlpack_device__(self):
            return right.__dlpack_device__()

    found = epipole.depth(Array(), Tensor(), disparities=64).disparity
    assert np.array_equal(found, expected, equal_nan=True)
    assert epipole.is_borrowed(left)


@pytest.mark.parametrize(
    ("image", "error", "words"),
    [
        (np.zeros((0, 5), np.uint8), errors.ShapeError, "no pixels"),
        (np.zeros((), np.uint8), errors.ShapeError, "shape"),
        (np.zeros(7, np.uint8), errors.ShapeError, "shape"),
        (np.zeros((4, 4, 4), np.uint8), errors.ShapeError, "alpha"),
        (np.zeros((4, 4, 2), np.uint8), errors.ShapeError, "height, width"),
        (np.zeros((2, 4, 4, 3), np.uint8), errors.ShapeError, "height, width"),
        (np.zeros((40, 40), np.float64), TypeError, "float64"),
        (np.zeros((40, 40), np.int32), TypeError, "int32"),
        (np.zeros((40, 40), bool), TypeError, "bool"),
        (np.full((40, 40), None), TypeError, "object"),
        ([[1, 2], [3, 4]], TypeError, "NumPy array"),
        ("left.png", TypeError, "NumPy array"),
        (None, TypeError, "NumPy array"),
        # 100 GB by its shape, without allocated memory.
        (np.broadcast_to(np.uint8(0), (1 << 18, 1 << 18, 3))[:, :, :2], errors.ShapeError, "shape"),
    ],
)
def test_invalid_arrays_are_refused(image, error, words):
    with pytest.raises(error, match=words):
        epipole.depth(image, image)
    with pytest.raises(error, match=words):
        epipole.match_features(image, np.zeros((60, 60, 3), np.uint8))


def test_incompatible_images_are_refused():
    a = np.zeros((40, 50), np.uint8)
    with pytest.raises(errors.ImageMismatchError) as refused:
        epipole.depth(a, a.astype(np.uint16))
    assert refused.value.left == (40, 50, 1)
    with pytest.raises(errors.SizeMismatchError) as refused:
        epipole.depth(a, a[:-1])
    assert (refused.value.left, refused.value.right) == ((50, 40), (50, 39))


def test_non_finite_photographs_are_refused(pair):
    left, right = (photo.astype(np.float32) / 255 for photo in pair)
    left[50:60, 50:60] = np.nan
    with pytest.raises(errors.NotFiniteError) as refused:
        epipole.depth(left, right, disparities=64)
    # Ten by ten pixels of three samples.
    assert (refused.value.count, refused.value.side) == (300, "left")
