"""Cameras, rigs and boards, against the cameras that rendered the photographs."""

import pickle

import epipole
import numpy as np
import pytest
import scenes
from epipole import errors

MATRIX = np.array([[420.0, 0, 163.0], [0, 418.0, 117.0], [0, 0, 1]])
SIZE = (320, 240)
# Meters.
SQUARE = 0.034
# Second camera of a rig: 0.12 to the right of the first, slightly rotated.
RIG = (scenes.rotation(0.01, -0.02, 0.005), np.array([-0.12, 0.002, 0.003]))


def board_poses():
    """Poses of the board in front of the camera, in meters."""
    random = np.random.default_rng(3)
    for i in range(12):
        tilt = scenes.rotation(*(random.uniform(-0.45, 0.45, 3)))
        middle = np.array([random.uniform(0.04, 0.08), random.uniform(-0.05, 0.05), random.uniform(0.7, 0.85)])
        yield tilt, middle - tilt @ np.array([3.5 * SQUARE, 2 * SQUARE, 0])


@pytest.fixture(scope="module")
def photographs():
    """Photographs of a chessboard of 8 by 5 inner corners with squares of 34 mm, by both cameras of a rig."""
    board = [((0, 0, 0), np.eye(3)[0], np.eye(3)[1], scenes.chessboard(8, 5, SQUARE))]
    r, t = RIG
    left = [scenes.render(board, MATRIX, pose, SIZE)[0] for pose in board_poses()]
    right = [scenes.render(board, MATRIX, (r @ a, r @ b + t), SIZE)[0] for a, b in board_poses()]
    return left, right


def test_the_corners_of_a_board_are_accurate(photographs):
    pose = next(iter(board_poses()))
    seen = epipole.find_board(photographs[0][0], board=epipole.Chessboard((8, 5), SQUARE))
    assert len(seen) == 40 and seen.size == (8, 5)
    true = np.c_[seen.points, np.zeros(40)] @ pose[0].T + pose[1]
    pixels = true @ MATRIX.T
    off = np.linalg.norm(seen.pixels - pixels[:, :2] / pixels[:, 2:], axis=1)
    # The target for clean generated photographs; rendering with 3×3 samples per pixel adds as much.
    assert np.median(off) < 0.06
    assert len(epipole.find_board(photographs[0][0])) == 40
    with pytest.raises(errors.BoardNotFoundError) as refused:
        epipole.find_board(photographs[0][0], board=epipole.CharucoBoard((8, 5), SQUARE, 0.02))
    assert refused.value.kind == "NoMarkers"
    with pytest.raises(errors.NoBoardError):
        epipole.find_board(np.zeros((100, 100), np.uint8))


def test_a_rig_is_calibrated(photographs, tmp_path):
    seen = []
    found = epipole.calibrate(list(photographs), board=epipole.Chessboard((8, 5), SQUARE), progress=lambda *at: seen.append(at))
    assert found.rms < 0.1 and len(found.cameras) == 2 and seen
    # Twelve photographs of 40 corners accurate to 0.03 px: standard deviations of about a pixel, which are reported.
    deviations = dict(zip(found.parameter_names, found.deviations))
    assert abs(found.cameras[0].matrix[0, 0] - 420) < 4 * deviations["camera0.fx"] < 8
    assert found.covariance.shape == (len(found.parameters),) * 2
    assert found.rig.baseline == pytest.approx(np.linalg.norm(RIG[1]), rel=0.005)
    angle = np.arccos(np.clip((np.trace(found.rig.rotation @ RIG[0].T) - 1) / 2, -1, 1))
    turn = np.linalg.norm([deviations[f"camera1.r{axis}"] for axis in "xyz"])
    assert angle < 4 * turn < 0.02
    assert all(reason is None for view in found.refused for reason in view)
    assert found.trust in ("poor", "usable", "good") and "2 cameras" in repr(found)
    again = pickle.loads(pickle.dumps(found))
    assert again.cameras == found.cameras and again.rig == found.rig
    found.rig.write(tmp_path / "rig.yaml")
    assert epipole.Rig.read(tmp_path / "rig.yaml") == epipole.Rig.read(str(tmp_path / "rig.yaml"))
    assert epipole.Rig.read(tmp_path / "rig.yaml").left == found.rig.left


def test_missing_and_empty_photographs_are_reported(photographs):
    left = list(photographs[0])
    left[2], left[3] = None, np.zeros((240, 320), np.uint8)
    found = epipole.calibrate(left, board=epipole.Chessboard((8, 5), SQUARE), lens="radial-tangential4")
    assert found.camera.lens == "radial_tangential4" and found.rig is None
    assert [view[0] is None for view in found.refused] == [i not in (2, 3) for i in range(12)]
    assert found.refused[2][0]["kind"] == "NoPhoto" and found.refused[3][0]["kind"] == "NoBoard"
    with pytest.raises(errors.NoBoardsError):
        epipole.calibrate([left[3]])
    with pytest.raises(FileNotFoundError):
        epipole.calibrate(["nowhere.png"])
    with pytest.raises(ValueError, match="12 photographs|another has"):
        epipole.calibrate([left, left[:3]])


def test_cameras_project_and_round_trip_through_files(tmp_path):
    camera = epipole.Camera(640, 480, [[500, 0, 320], [0, 510, 240], [0, 0, 1]], [-0.2, 0.05, 0.001, -0.002, 0.01])
    assert camera.lens == "radial_tangential5" and camera.distortion.shape == (5,)
    points = np.array([[0.1, -0.2, 2.0], [0.4, 0.3, 1.5], [0, 0, -1]])
    pixels = camera.project(points)
    # The formula of OpenCV's documentation.
    x, y = points[0, :2] / points[0, 2]
    r2, (k1, k2, p1, p2, k3) = x * x + y * y, camera.distortion
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    assert np.allclose(pixels[0], [500 * expected[0] + 320, 510 * expected[1] + 240])
    assert np.isnan(pixels[2]).all()
    assert np.allclose(camera.normalize(pixels[:2]), points[:2, :2] / points[:2, 2:], atol=1e-9)
    straight = camera.undistort_points(pixels[:2])
    assert np.allclose(straight, points[:2, :2] / points[:2, 2:] * [500, 510] + [320, 240], atol=1e-6)
    for format, name in (("own", "a.yaml"), ("opencv", "b.yaml"), ("opencv-xml", "c.xml"), ("ros", "d.yaml")):
        camera.write(tmp_path / name, format=format)
        assert epipole.Camera.read(tmp_path / name) == camera, format
    assert pickle.loads(pickle.dumps(camera)) == camera and hash(camera) == hash(pickle.loads(pickle.dumps(camera)))
    assert camera != epipole.Camera.from_focal(640, 480, 500) and camera.resized(320, 240).width == 320
    fisheye = epipole.Camera(640, 480, camera.matrix, np.zeros(4), lens="fisheye4")
    assert fisheye.lens == "fisheye4" and epipole.Camera(640, 480, camera.matrix).lens == "none"
    for wrong in (
        lambda: epipole.Camera(640, 480, np.eye(4)),
        lambda: epipole.Camera(640, 480, [[1, 2, 3], [0, 1, 1], [0, 0, 1]]),
        lambda: epipole.Camera(640, 480, camera.matrix, [1, 2, 3]),
        lambda: epipole.Camera(640, 480, camera.matrix, [np.nan] * 4),
        lambda: epipole.Camera(640, 480, camera.matrix, [0] * 4, "barrel"),
        lambda: epipole.Camera.from_focal(640, 480, -1),
        lambda: camera.write(tmp_path / "e.yaml", format="pdf"),
        lambda: epipole.Rig(camera, camera, np.eye(3), [0, 0, 0]),
        lambda: epipole.Rig(camera, camera, 2 * np.eye(3), [1, 0, 0]),
    ):
        with pytest.raises((ValueError, errors.EpipoleError)):
            wrong()
    (tmp_path / "f.yaml").write_text("not: [a camera")
    with pytest.raises(errors.FileError):
        epipole.Camera.read(tmp_path / "f.yaml")
    with pytest.raises(FileNotFoundError):
        epipole.Rig.read(tmp_path / "nowhere.yaml")


def test_a_pair_of_a_rig_is_rectified_and_gives_depth():
    camera = epipole.Camera(*SIZE, MATRIX)
    rig = epipole.Rig(camera, camera, *RIG, unit="m")
    pose = (np.eye(3), np.zeros(3))
    left, depth = scenes.render(scenes.room(), MATRIX, pose, SIZE)
    right, _ = scenes.render(scenes.room(), MATRIX, RIG, SIZE)
    pair = epipole.rectify(left, right, rig)
    assert pair.left.shape == left.shape and pair.masks[0].dtype == bool and pair.vertical_px[0] < 0.4
    assert np.allclose(pair.Q, epipole.depth(left, right, rig=rig, disparities=48).Q)
    found = epipole.depth(left, right, rig=rig, disparities=48, cloud=True)
    assert found.images[0].shape == left.shape and len(found.cloud) > 10_000
    # The cloud is in the frame of the original left camera: each point is compared with the rendered depth at its pixel.
    pixels = camera.project(found.cloud.positions)
    at = np.rint(pixels).astype(int)
    inside = (at >= 0).all(1) & (at < SIZE).all(1)
    true = depth[at[inside, 1], at[inside, 0]]
    off = np.abs(found.cloud.positions[inside, 2] / true - 1)
    # The target for depths below 10 m.
    assert np.mean(off < 0.05) > 0.95 and inside.mean() > 0.9
    with pytest.raises(TypeError):
        epipole.depth(left, right, rig=rig, focal=420, baseline=0.1)
    with pytest.raises(errors.ImageSizeError):
        epipole.depth(left[:-1], right[:-1], rig=rig)
    with pytest.raises(errors.EpipoleError, match="exchanged"):
        epipole.rectify(left, right, rig.exchanged())


def test_a_distorted_photograph_is_undistorted():
    camera = epipole.Camera(*SIZE, MATRIX, [-0.25, 0.06, 0, 0])
    image, _ = scenes.render(scenes.room(), MATRIX, (np.eye(3), np.zeros(3)), SIZE)
    for given in (image, image[..., 0], image.astype(np.uint16) * 257, image.astype(np.float32) / 255):
        straight, pinhole = epipole.undistort(given, camera)
        undistorter = epipole.Undistorter(camera)
        assert straight.dtype == given.dtype and straight.shape == given.shape
        assert pinhole.lens == "none" and undistorter.camera == pinhole
        assert np.array_equal(undistorter.compute(given), straight)
    # An undistorted pixel has the color of the distorted photograph on the same ray.
    straight, pinhole = epipole.undistort(image[..., 0].astype(np.float32), camera)
    rays = np.c_[pinhole.normalize([[100, 80], [250, 190]]), np.ones(2)]
    for (x, y), value in zip(camera.project(rays), (straight[80, 100], straight[190, 250])):
        i, j, a, b = int(x), int(y), x % 1, y % 1
        values = image[j : j + 2, i : i + 2, 0].astype(float)
        expected = np.array([1 - b, b]) @ values @ np.array([1 - a, a])
        # Source positions are fixed-point numbers of 1/32 px; neighboring pixels differ by up to 60 levels.
        assert abs(value - expected) < 2
    with pytest.raises(errors.ImageSizeError):
        epipole.undistort(image[:-1], camera)
    with pytest.raises(errors.EpipoleError):
        epipole.Undistorter(camera).compute(image[:-1])
    with pytest.raises(errors.OptionError):
        epipole.undistort(image, camera, alpha=2)
