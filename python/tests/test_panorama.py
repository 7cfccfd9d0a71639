"""Panoramas of the generated photographs, whose homographies are known."""

import json

import epipole
import numpy as np
import pytest
from conftest import FIXTURES
from epipole import errors

VIEWS = [FIXTURES / "panorama" / f"view{i}.jpg" for i in range(3)]


def test_photographs_are_stitched_and_unrelated_ones_left_out(plane):
    known = json.loads((FIXTURES / "oracle" / "panorama.json").read_text())
    photographs = [epipole.read_image(path) for path in VIEWS]
    found = epipole.panorama([*photographs, plane[0]], focal=known["focal_px"])
    assert sorted(found.views) == [0, 1, 2] and found.left_out[3]["kind"] == "NoOverlap"
    assert found.image.shape[:2] == found.mask.shape == found.labels.shape
    assert set(np.unique(found.labels)) <= {0, 1, 2, 65535} and (found.labels == 65535)[~found.mask].all()
    height, width = photographs[0].shape[:2]
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], float).T
    (k0, r0), (k1, r1) = found.views[0], found.views[1]
    mapped = k1.matrix @ r1 @ r0.T @ np.linalg.inv(k0.matrix) @ corners
    true = np.array(known["homographies"][0]) @ corners
    # The homographies of the file are between neighbors, in either direction.
    both = [np.abs(mapped[:2] / mapped[2] - h[:2] / h[2]).max() for h in (true, np.linalg.inv(known["homographies"][0]) @ corners)]
    # The target of the golden figures: 1.5 px at the corners.
    assert min(both) < 1.5
    assert "3 photographs" in repr(found) and "<img" in found._repr_html_()


def test_paths_and_arrays_give_the_same_result():
    found = epipole.panorama(VIEWS, scale=0.5)
    again = epipole.panorama([epipole.read_image(path) for path in VIEWS], scale=0.5)
    assert np.array_equal(found.image, again.image)
    with pytest.raises(FileNotFoundError):
        epipole.panorama([*VIEWS, "nowhere.jpg"])
    with pytest.raises(errors.TooFewPhotosError):
        epipole.panorama(VIEWS[:1])
    with pytest.raises(ValueError, match="cubic"):
        epipole.panorama(VIEWS, projection="cubic")


def test_16_bit_photographs_give_a_16_bit_panorama():
    photographs = [epipole.read_image(path) for path in VIEWS]
    deep = [p.astype(np.uint16) * 257 for p in photographs]
    plain = epipole.panorama(photographs, scale=0.5)
    found = epipole.panorama(deep, scale=0.5)
    assert plain.image.dtype == np.uint8 and found.image.dtype == np.uint16 and found.image.shape == plain.image.shape
    # The same up to rounding, except where rounding moves a seam.
    assert (np.abs(found.image / 257 - plain.image) > 1.1).mean() < 1e-3 and (found.image % 257 != 0).mean() > 0.9
    assert "<img" in found._repr_html_()
    mixed = epipole.panorama([photographs[0], *deep[1:]], scale=0.5)
    assert np.array_equal(mixed.image, found.image)
    with pytest.raises(TypeError, match="uint16"):
        epipole.panorama([p.astype(np.float32) for p in photographs])


def test_masks_remove_and_keep_parts_of_photographs():
    photographs = [epipole.read_image(path) for path in VIEWS]
    height, width = photographs[0].shape[:2]
    # The middle of the middle photograph, of which its neighbors show a part each.
    middle = np.zeros((height, width), bool)
    middle[:, width // 4 : -width // 4] = True
    found = epipole.panorama(photographs, remove=[None, middle, None])
    registered = {"registration": found.registration, "scale": 0.5, "blend": "none"}
    plain = epipole.panorama(photographs, **registered)
    removed = epipole.panorama(photographs, remove=[None, middle, None], **registered)
    kept = epipole.panorama(photographs, keep=[None, 255 * middle.astype(np.uint8)], **registered)
    pixels = [int((p.labels == 1).sum()) for p in (removed, plain, kept)]
    # Half of the photograph's width is removed, at a quarter of its pixels, less what lies beyond the seams.
    assert pixels[0] < pixels[1] - width * height // 16 and pixels[2] >= width * height // 8 * 0.95, pixels
    both = epipole.panorama(photographs, keep=[None, middle], remove=[None, middle], **registered)
    assert np.array_equal(both.image, removed.image)
    with pytest.raises(errors.EpipoleError, match="mask of photograph 1"):
        epipole.panorama(photographs, keep=[None, middle[:-1]])
    with pytest.raises(ValueError, match="4 masks for 3 photographs"):
        epipole.panorama(photographs, remove=[None] * 4)
    with pytest.raises(ValueError, match=r"keep\[0\] has"):
        epipole.panorama(photographs, keep=[middle], remove=[middle.T])


def test_a_field_of_view_is_rendered():
    whole = epipole.panorama(VIEWS, scale=0.5, projection="stereographic")
    part = epipole.panorama(VIEWS, scale=0.5, projection="stereographic", fov=(40, 30), center=(-3, 1), roll=2.0)
    # 2 tan(fov / 4) to each side: the ratio of the sides is that of the tangents, to a pixel.
    height, width = part.image.shape[:2]
    assert abs(width / height - np.tan(np.radians(10)) / np.tan(np.radians(7.5))) < 0.02
    assert whole.image.shape[1] > width
    assert epipole.panorama(VIEWS, scale=0.5, projection="panini", fov=40).image.shape[1] > 50
    with pytest.raises(ValueError, match="pitch"):
        epipole.panorama(VIEWS, center=(0, 120))
    with pytest.raises(TypeError, match="fov"):
        epipole.panorama(VIEWS, fov="wide")
    with pytest.raises(errors.EpipoleError, match="150"):
        epipole.panorama(VIEWS, projection="plane", fov=170)


def test_a_registration_renders_other_photographs_of_the_views():
    photographs = [epipole.read_image(path) for path in VIEWS]
    first = epipole.panorama(photographs, scale=0.5)
    again = epipole.panorama(photographs, scale=0.5, registration=first.registration)
    assert np.array_equal(first.image, again.image) and "match" not in again.seconds
    assert again.registration == first.registration
    darker = epipole.panorama([p // 2 for p in photographs], scale=0.5, registration=first.registration)
    assert darker.image.shape == first.image.shape and darker.image.mean() < first.image.mean()
    with pytest.raises(errors.EpipoleError, match="2 photographs for a registration of 3"):
        epipole.panorama(photographs[:2], registration=first.registration)
    with pytest.raises(ValueError, match="registration"):
        epipole.panorama(photographs, registration="{}")
