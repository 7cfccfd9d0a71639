"""Jobs over Ray Data on one machine: broken files, a killed worker, a second run. Skipped if Ray is not installed."""

import os
import shutil
import signal
import threading
import time

import epipole
import numpy as np
import pytest
import scenes
from conftest import FIXTURES

pytestmark = pytest.mark.cluster
ray = pytest.importorskip("ray")


@pytest.fixture(scope="module")
def cluster():
    """Two nodes of two processors each, on this machine."""
    from ray.cluster_utils import Cluster

    os.environ["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False, "object_store_memory": 80_000_000})
    nodes.add_node(num_cpus=2, object_store_memory=80_000_000)
    ray.init(address=nodes.address, log_to_driver=False)
    ray.data.DataContext.get_current().enable_progress_bars = False
    yield nodes
    ray.shutdown()
    nodes.shutdown()


def rows(dataset):
    return sorted(dataset.take_all(), key=lambda row: row["name"])


CORRUPT = {3, 9, 10, 57, 100, 101, 163, 200, 231, 239}
"""Indices of the broken pairs."""


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """Writes 240 small pairs with unique names, ten of them broken."""
    folder = tmp_path_factory.mktemp("pairs")
    for side in ("left", "right"):
        image = epipole.read_image(FIXTURES / "stereo" / f"{side}.jpg")
        epipole.write_image(folder / f"{side}.png", np.ascontiguousarray(image[60:180, 100:300]))
        for i in range(240):
            shutil.copy(folder / f"{side}.png", folder / f"{side}{i:03}.png")
    for i in CORRUPT:
        (folder / f"left{i:03}.png").write_bytes(b"no image")
    return [(folder / f"left{i:03}.png", folder / f"right{i:03}.png") for i in range(240)]


def test_bad_files_are_rows_with_an_error_and_a_second_run_computes_nothing(cluster, pairs, tmp_path):
    killed = []
    killer = threading.Thread(target=kill_one, args=(tmp_path, killed))
    killer.start()
    found = rows(epipole.ray.depth(pairs, tmp_path / "d", disparities=64, actors=2))
    killer.join()
    assert killed or not os.path.isdir("/proc")
    assert [row["error"] is not None for row in found] == [i in CORRUPT for i in range(240)]
    assert all("FileError" in row["error"] and row["output"] is None for row in found if row["error"])
    images = [epipole.read_image(path) for path in pairs[0]]
    expected = epipole.depth(*images, disparities=64)
    for row in found:
        if row["error"] is None:
            with np.load(row["output"]) as arrays:
                assert np.array_equal(arrays["disparity"], expected.disparity, equal_nan=True)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "d").iterdir()}
    again = rows(epipole.ray.depth(pairs, tmp_path / "d", disparities=64, actors=1))
    assert [row["skipped"] for row in again] == [row["error"] is None for row in found]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "d").iterdir()} == written
    with pytest.raises(ValueError, match="other options"):
        epipole.ray.depth(pairs, tmp_path / "d", disparities=48)


def kill_one(folder, killed):
    """Kills a worker after the first result."""
    end = time.monotonic() + 60
    while time.monotonic() < end and not list(folder.glob("d/*.npz")):
        time.sleep(0.02)
    for entry in os.listdir("/proc") if os.path.isdir("/proc") else ():
        try:
            with open(f"/proc/{entry}/cmdline", "rb") as file:
                command = file.read()
        except OSError:
            continue
        # Ray's process name of a worker with one of our actors.
        if b"MapWorker" in command and entry.isdigit():
            os.kill(int(entry), signal.SIGKILL)
            killed.append(command)
            return


def test_every_other_job_runs_on_the_cluster(cluster, tmp_path):
    photographs = [FIXTURES / "ball" / f"ball{i}.jpg" for i in range(4)]
    masks = [epipole.read_image(FIXTURES / "oracle" / "ball-masks" / f"ball{i}_mask.png") for i in range(4)]
    images = [epipole.read_image(path) for path in photographs]
    model = epipole.ColorModel().fit(images, masks)
    found = rows(epipole.ray.segment(photographs, tmp_path / "s", model=model))
    assert all(row["found"] == 1 for row in found)
    assert np.array_equal(epipole.read_image(found[0]["output"]) > 0, model.locate(images[0]).mask)

    height, width = images[0].shape[:2]
    camera = epipole.Camera(width, height, [[200, 0, 80], [0, 200, 60], [0, 0, 1]], [-0.1, 0, 0, 0])
    found = rows(epipole.ray.undistort(photographs, tmp_path / "u", camera=camera, alpha=1.0))
    assert np.array_equal(epipole.read_image(found[1]["output"]), epipole.undistort(images[1], camera, alpha=1.0)[0])

    nearly = epipole.Camera(width, height, [[200 + 1e-9, 0, 80], [0, 200, 60], [0, 0, 1]], [-0.1, 0, 0, 0])
    with pytest.raises(ValueError, match="other options"):
        epipole.ray.undistort(photographs, tmp_path / "u", camera=nearly, alpha=1.0)

    plane = [FIXTURES / "plane" / f"{name}.jpg" for name in "ab"]
    found = rows(epipole.ray.features(plane, tmp_path / "f", max_features=500))
    files = [row["output"] for row in found]
    a, b = (epipole.ray.load_features(path) for path in files)
    expected = epipole.extract_features(epipole.read_image(plane[0]), max_features=500)
    assert len(a) == found[0]["count"] and a.kind == expected.kind
    assert np.array_equal(a.descriptors, expected.descriptors)
    expected = epipole.match(a, b)
    dataset = ray.data.from_items([{"a": files[0], "b": files[1]}])
    found = rows(epipole.ray.match_pairs(dataset, tmp_path / "m"))
    assert found[0]["count"] == len(expected) > 20 and found[0]["error"] is None
    # As a list, with options, and with a pair of which one file is missing.
    listed = [(files[0], files[1]), (files[0], tmp_path / "nowhere.npz")]
    found = rows(epipole.ray.match_pairs(listed, tmp_path / "n", guided="homography", seed=3))
    assert [row["name"] for row in found] == ["a-b", "a-nowhere"]
    guided = epipole.match(a, b, guided="homography", seed=3)
    with np.load(found[0]["output"]) as arrays:
        assert np.array_equal(arrays["points"], guided.points) and np.array_equal(arrays["indices"], guided.indices)
        assert np.array_equal(arrays["ratios"], guided.ratios)
    assert len(guided) > len(expected) and found[1]["error"].startswith("FileNotFoundError") and found[1]["output"] is None


def test_many_views_with_features_from_the_cluster(cluster, tmp_path):
    paths = [tmp_path / f"{i}.png" for i in range(5)]
    for path, image in zip(paths[:4], scenes.walk()):
        epipole.write_image(path, image)
    camera = epipole.Camera(*scenes.WALK_SIZE, scenes.WALK_MATRIX)
    found = epipole.ray.sfm(paths, tmp_path / "features", camera=camera)
    assert list(found.left_out) == ["4.png"] and "FileNotFoundError" in found.left_out["4.png"]["message"]
    expected = epipole.sfm(paths[:4], camera=camera)
    assert np.array_equal(found.model.points, expected.model.points)
    # Two unreadable files of the same name in two folders.
    more = [*paths[:4], tmp_path / "x" / "9.png", tmp_path / "y" / "9.png"]
    found = epipole.ray.sfm(more, tmp_path / "more", names=["a", "b", "c", "d", "x9", "y9"], camera=camera)
    assert sorted(found.left_out) == ["x9", "y9"] and [image.name for image in found.model.images.values()] == ["a", "b", "c", "d"]


def test_invalid_options_are_reported_before_the_computation(cluster, tmp_path):
    paths = ["a/x.jpg", "b/x.jpg"]
    with pytest.raises(ValueError, match="names="):
        epipole.ray.features(paths, tmp_path / "f")
    with pytest.raises(TypeError, match="max_featurs"):
        epipole.ray.features(paths, tmp_path / "f", max_featurs=3)
    with pytest.raises(ValueError, match="no photographs"):
        epipole.ray.features([], tmp_path / "f")
    with pytest.raises(ValueError, match="left and right"):
        epipole.ray.depth([("a.jpg",)], tmp_path / "d")
    found = rows(epipole.ray.features(paths, tmp_path / "g", names=["one", "two"]))
    assert all(row["error"].startswith("FileNotFoundError") for row in found)
