"""The package's results for the generated photographs of the repository equal the program's outputs, byte for byte."""

import json
import os
import subprocess

import epipole
import numpy as np
import pytest
from conftest import FIXTURES

PROGRAM = os.environ.get("EPIPOLE_PROGRAM")
pytestmark = pytest.mark.skipif(not PROGRAM, reason="EPIPOLE_PROGRAM does not name the program")


def run(*arguments):
    """Runs the program and returns its JSON."""
    done = subprocess.run([PROGRAM, *map(str, arguments), "--json"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_depth(pair, stereo_truth, tmp_path):
    focal, baseline = stereo_truth[:2]
    photographs = [FIXTURES / "stereo" / f"{side}.jpg" for side in ("left", "right")]
    known = ["--focal", focal, "--baseline", baseline]
    run("depth", *photographs, "--disparities", 64, *known, "-o", tmp_path / "d.pfm", "--depth", tmp_path / "z.pfm", "--cloud", tmp_path / "c.ply")
    found = epipole.depth(*pair, disparities=64, focal=focal, baseline=baseline, cloud=True)
    epipole.write_map(tmp_path / "d2.pfm", found.disparity)
    epipole.write_map(tmp_path / "z2.pfm", found.depth)
    found.cloud.write(tmp_path / "c2.ply")
    for one, two in (("d.pfm", "d2.pfm"), ("z.pfm", "z2.pfm"), ("c.ply", "c2.ply")):
        assert (tmp_path / one).read_bytes() == (tmp_path / two).read_bytes(), one


def test_matches_and_their_homography(plane, tmp_path):
    told = run("match", FIXTURES / "plane" / "a.jpg", FIXTURES / "plane" / "b.jpg", "-o", tmp_path / "m.txt")
    found = epipole.match_features(*plane[:2])
    assert told["matches"] == len(found)
    model = run("estimate", "homography", "--matches", tmp_path / "m.txt")
    # The file has fewer digits than the matches; the same matches give the same model.
    rows = np.loadtxt(tmp_path / "m.txt")[:, :4]
    assert np.abs(rows - found.points).max() < 1e-3
    assert np.array_equal(np.array(model["model"]).reshape(3, 3), epipole.estimate_homography(rows).model)


def test_a_panorama(tmp_path):
    photographs = [FIXTURES / "panorama" / f"view{i}.jpg" for i in range(3)]
    run("panorama", *photographs, "-o", tmp_path / "p.png")
    assert np.array_equal(epipole.read_image(tmp_path / "p.png"), epipole.panorama(photographs).image)


def test_openexr_files_of_the_program_are_read(tmp_path):
    photographs = [FIXTURES / "panorama" / f"view{i}.jpg" for i in range(3)]
    found = run("panorama", *photographs, "-o", tmp_path / "light.exr")
    radiance = epipole.read_image(tmp_path / "light.exr")
    assert radiance.dtype == np.float32 and radiance.shape[2] == 3 and np.isfinite(radiance).all()
    # A room in daylight: not black, and no more than some times the exposure of its photographs.
    assert 0.05 < np.median(radiance) < 2.0, found


def test_two_views(tmp_path):
    photographs = [FIXTURES / "two-view" / f"{name}.jpg" for name in "ab"]
    focal = json.loads((FIXTURES / "oracle" / "two-view.json").read_text())["focal_px"]
    options = ["--focal", focal, "--dense", tmp_path / "dense.ply", "--colmap", tmp_path / "model"]
    run("reconstruct", *photographs, "-o", tmp_path / "sparse.ply", *options)
    found = epipole.reconstruct(*photographs, focal=focal, dense=True)
    found.reconstruction.cloud.write(tmp_path / "sparse2.ply")
    found.dense.write(tmp_path / "dense2.ply")
    for name in ("sparse", "dense"):
        assert (tmp_path / f"{name}.ply").read_bytes() == (tmp_path / f"{name}2.ply").read_bytes(), name
    found.reconstruction.write(tmp_path / "model2")
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        assert (tmp_path / "model" / name).read_bytes() == (tmp_path / "model2" / name).read_bytes(), name


def test_the_masks_of_a_ball(tmp_path):
    photographs = [FIXTURES / "ball" / f"ball{i}.jpg" for i in range(8)]
    masks = [FIXTURES / "oracle" / "ball-masks" / f"ball{i}_mask.png" for i in range(8)]
    run("segment", "train", "--images", *photographs[:4], "--masks", masks[0].parent, "--model", tmp_path / "ball.json")
    run("segment", "predict", "--model", tmp_path / "ball.json", *photographs[4:], "-o", tmp_path / "found")
    images = [epipole.read_image(path) for path in photographs]
    model = epipole.ColorModel().fit(images[:4], [epipole.read_image(path) > 0 for path in masks[:4]])
    model.save(tmp_path / "ours.json")
    assert json.loads((tmp_path / "ours.json").read_text()) == json.loads((tmp_path / "ball.json").read_text())
    for image, path in zip(images[4:], photographs[4:]):
        written = epipole.read_image(tmp_path / "found" / f"{path.stem}_mask.png") > 0
        assert np.array_equal(model.locate(image).mask, written)
