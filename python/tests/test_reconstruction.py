"""Two views, many views, models and their files, against the cameras that rendered the photographs."""

import pickle

import epipole
import numpy as np
import pytest
import scenes
from epipole import errors
from scenes import WALK_MATRIX as MATRIX
from scenes import WALK_SIZE as SIZE


@pytest.fixture(scope="module")
def photographs():
    return list(scenes.walk())


def angle(a, b):
    """Returns the angle between two rotations, in degrees."""
    # By the sine, which is accurate for small angles.
    return np.degrees(2 * np.arcsin(min(np.linalg.norm(a - b) / np.sqrt(8), 1)))


def test_the_relative_pose_of_two_photographs(photographs, tmp_path):
    camera = epipole.Camera(*SIZE, MATRIX)
    found = epipole.reconstruct(photographs[0], photographs[1], camera=camera, dense=True)
    (r0, t0), (r1, t1) = list(scenes.walk_poses())[:2]
    # The target for generated pairs.
    assert angle(found.rotation, r1 @ r0.T) < 0.2
    direction = t1 - r1 @ r0.T @ t0
    assert np.degrees(np.arccos(found.translation @ direction / np.linalg.norm(direction))) < 1
    assert found.rms < 1 and len(found.points) > 200 and found.cameras == (camera, camera)
    assert len(found.dense) > 10_000 and found.dense.colors.shape == found.dense.positions.shape
    again = pickle.loads(pickle.dumps(found))
    assert np.array_equal(again.points, found.points) and repr(again) == repr(found)
    found.dense.write(tmp_path / "dense.ply")
    assert (tmp_path / "dense.ply").read_bytes().startswith(b"ply\nformat binary")


def test_degenerate_pairs_raise_their_exception(photographs):
    with pytest.raises(errors.EpipoleError) as refused:
        epipole.reconstruct(photographs[0], photographs[0], focal=400)
    assert refused.value.kind
    with pytest.raises(ValueError):
        epipole.reconstruct(*photographs[:2], focal=0)
    with pytest.raises(TypeError, match="mutually exclusive"):
        epipole.reconstruct(*photographs[:2], focal=400, camera=MATRIX)
    with pytest.raises(errors.CameraSizeError):
        epipole.reconstruct(*photographs[:2], camera=epipole.Camera.from_focal(100, 100, 90))
    with pytest.raises(FileNotFoundError):
        epipole.reconstruct("nowhere.jpg", photographs[0])


def test_many_photographs(photographs, tmp_path):
    camera = epipole.Camera(*SIZE, MATRIX)
    truth = list(scenes.walk_poses())
    centers = np.array([-r.T @ t for r, t in truth])
    gray = np.full((300, 400), 128, np.uint8)
    names = [f"{i}.png" for i in range(5)] + ["gray.png"]
    found = epipole.sfm([*photographs, gray], camera=camera, names=names, centers=[*centers, [np.nan] * 3])
    assert found.frames == ("centers",) and list(found.left_out) == ["gray.png"]
    model = found.model
    assert [image.name for image in model.images.values()] == names[:5]
    for image, (r, _), center in zip(model.images.values(), truth, centers):
        # Half a pixel at a focal length of 400 px, and the corresponding length at the distance of the walls, 6 m.
        assert angle(image.rotation, r) < 0.07 and np.linalg.norm(image.center - center) < 0.01
    walls = np.min(np.abs(np.c_[model.points[:, 2] - 6, model.points[:, 0] - 3, model.points[:, 1] - 1.4]), axis=1)
    assert np.median(walls) < 0.02 and len(model.points) > 300
    # The keypoints of a point are at its projections.
    image = model.images[2]
    rows = {int(id): row for row, id in enumerate(model.point_ids)}
    seen = image.point_ids >= 0
    at = model.points[[rows[int(id)] for id in image.point_ids[seen]]] @ image.rotation.T + image.translation
    assert np.median(np.linalg.norm(camera.project(at) - image.keypoints[seen], axis=1)) < 1
    for format in ("colmap-text", "colmap-binary"):
        model.write(tmp_path / format, format=format)
        again = epipole.Reconstruction.read(tmp_path / format)
        assert repr(again) == repr(model) and again.cameras == model.cameras
        assert np.allclose(again.points, model.points, atol=1e-9) and np.array_equal(again.colors, model.colors)
        for one, two in zip(again.images.values(), model.images.values()):
            assert np.array_equal(one.point_ids, two.point_ids) and np.allclose(one.rotation, two.rotation, atol=1e-9)
    upright = epipole.sfm(photographs, camera=camera)
    assert upright.frames == ("upright",) and len(upright.model) == 5


def test_positions_and_distances_georeference_the_model(photographs, tmp_path):
    camera = epipole.Camera(*SIZE, MATRIX)
    centers = np.array([-r.T @ t for r, t in scenes.walk_poses()])
    between = np.linalg.norm(centers[4] - centers[0])
    found = epipole.sfm(photographs, camera=camera, distances=[(0, 4, 10 * between)])
    first, last = (found.model.images[i].center for i in (1, 5))
    # The distance alone determines the scale: exact up to rounding.
    assert found.frames == ("distances",) and np.linalg.norm(last - first) == pytest.approx(10 * between)
    # A degree of latitude is the meridian's radius times π/180: 110.57 km at the equator, where a degree of longitude is 111.32 km.
    east, north = 6_378_137.0, 6_335_439.3
    gps = [(y / north, x / east, 50.0 - z) for x, z, y in centers]
    seen = [epipole.sfm_features(photograph, name=str(i)) for i, photograph in enumerate(photographs)]
    assert seen[0].gps is None
    told = [with_gps(one, place) for one, place in zip(seen, gps)]
    assert pickle.loads(pickle.dumps(told[2])).gps == gps[2]
    found = epipole.sfm(told, camera=camera)
    assert found.frames == ("gps",)
    size = [np.linalg.norm(image.center - found.model.images[1].center) for image in found.model.images.values()]
    # As with the centers above.
    assert np.allclose(size, np.linalg.norm(centers - centers[0], axis=1), atol=0.02)
    assert epipole.sfm(told, camera=camera, ignore_gps=True).frames == ("upright",)
    for wrong in ([(0, 0, 1.0)], [(0, 5, 1.0)], [(0, 1, 0.0)], [(0, 1, np.nan)]):
        with pytest.raises(ValueError, match="distances"):
            epipole.sfm(told, camera=camera, distances=wrong)
    with pytest.raises(ValueError, match="distances"):
        epipole.sfm(told, camera=camera, distances=[(0, 1)])


def with_gps(seen, place):
    """Returns features as of a photograph with a GPS position in EXIF."""
    make, (name, size, (focal, _), *rest) = seen.__reduce__()
    return make(name, size, (focal, place), *rest)


def test_photographs_that_are_left_out_keep_their_names(photographs, tmp_path):
    camera = epipole.Camera(*SIZE, MATRIX)
    turned = np.ascontiguousarray(photographs[0].transpose(1, 0, 2))
    found = epipole.sfm([*photographs, turned], camera=camera)
    assert found.left_out == {"5": {"kind": "CameraSize", "photo": (300, 400), "camera": SIZE}}
    assert len(found.model.images) == 5
    # Unreadable files are left out by their path.
    bad = [tmp_path / folder / "bad.jpg" for folder in "xy"]
    for path in bad:
        path.parent.mkdir()
        path.write_bytes(b"no image")
    found = epipole.sfm([*photographs, *bad], camera=camera)
    assert list(found.left_out) == [str(path) for path in bad]
    seen = [epipole.sfm_features(photograph, name="one") for photograph in photographs]
    names = [image.name for image in epipole.sfm(seen, camera=camera).model.images.values()]
    assert names == ["one", "one#2", "one#3", "one#4", "one#5"]
    with pytest.raises(ValueError, match="used twice"):
        epipole.sfm(photographs, camera=camera, names=["a", "b", "c", "d", "a"])


def test_extracted_features_give_the_same_model(photographs):
    camera = epipole.Camera(*SIZE, MATRIX)
    seen = [epipole.sfm_features(photograph, name=f"{i}") for i, photograph in enumerate(photographs)]
    seen = pickle.loads(pickle.dumps(seen))
    assert seen[0].size == SIZE and len(seen[0]) == len(seen[0].keypoints) and "400×300" in repr(seen[0])
    one, two = (epipole.sfm(given, camera=camera).model for given in (photographs, seen))
    assert np.array_equal(one.points, two.points) and np.array_equal(one.colors, two.colors)
    with pytest.raises(errors.ImageTooSmallError):
        epipole.sfm_features(np.zeros((3, 3), np.uint8))


def test_pycolmap_models_round_trip(photographs):
    pycolmap = pytest.importorskip("pycolmap")
    model = epipole.sfm(photographs, camera=epipole.Camera(*SIZE, MATRIX)).model
    theirs = model.to_pycolmap()
    assert isinstance(theirs, pycolmap.Reconstruction) and theirs.num_points3D() == len(model.points)
    again = epipole.Reconstruction.from_pycolmap(theirs)
    assert np.allclose(again.points, model.points) and again.cameras == model.cameras
    assert np.allclose(again.images[1].keypoints, model.images[1].keypoints)


def test_photographs_without_a_model_are_errors(photographs, tmp_path):
    gray = np.full((300, 400), 128, np.uint8)
    with pytest.raises(errors.NoPairsError) as refused:
        epipole.sfm([gray, gray])
    assert refused.value.kind == "NoPairs"
    with pytest.raises(TypeError, match="list"):
        epipole.sfm("photographs")
    with pytest.raises(ValueError, match="names"):
        epipole.sfm(photographs, names=["a"])
    with pytest.raises(FileNotFoundError):
        epipole.Reconstruction.read(tmp_path)
    model = epipole.Reconstruction({}, {}, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(1), np.arange(2))
    with pytest.raises(ValueError, match="length"):
        model.write(tmp_path / "m")


def test_the_absolute_pose_from_known_points():
    random = np.random.default_rng(7)
    points = random.uniform([-2, -1, 3], [2, 1, 8], (120, 3))
    r, t = scenes.rotation(0.1, -0.3, 0.05), np.array([0.3, -0.1, 0.4])
    camera = epipole.Camera(*SIZE, MATRIX, [-0.1, 0.02, 0, 0])
    pixels = camera.project(points @ r.T + t)
    wrong = np.arange(120) % 3 == 0
    pixels[wrong] += random.uniform(30, 60, (wrong.sum(), 2))
    found = epipole.estimate_pose(points, pixels, camera)
    # Exact up to rounding.
    assert angle(found.rotation, r) < 1e-6 and np.allclose(found.translation, t, atol=1e-7)
    assert np.array_equal(found.inliers, ~wrong) and np.allclose(found.center, -r.T @ t, atol=1e-7)
    with pytest.raises(errors.NotEnoughMatchesError) as refused:
        epipole.estimate_pose(points[:3], pixels[:3], camera)
    assert (refused.value.got, refused.value.needed) == (3, 4)
    with pytest.raises(ValueError):
        epipole.estimate_pose(points, pixels[:5], camera)


def test_matching_features_equals_matching_photographs(photographs):
    a, b = (epipole.extract_features(photograph) for photograph in photographs[:2])
    found = epipole.match(a, b)
    assert np.array_equal(found.points, epipole.match_features(*photographs[:2], affine_simulation="never").points)
    theirs = [epipole.Features(f.keypoints, f.descriptors) for f in (a, b)]
    # Features of another program, of unknown descriptor kind.
    assert len(epipole.match(*theirs)) > 0.5 * len(found)
    with pytest.raises(errors.EpipoleError):
        epipole.match(a, theirs[1])
    with pytest.raises(ValueError, match="descriptors"):
        epipole.match(epipole.Features(a.keypoints[:-1], a.descriptors), b)
