"""Fixtures: the small generated images of the repository with their ground truth."""

import json
import os
import signal
from pathlib import Path

import epipole
import numpy as np
import pytest

# A shell that runs the tests in the background makes them, and all their child processes, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config):
    config.addinivalue_line("markers", "cluster: starts the processes of a cluster")


FIXTURES = Path(os.environ.get("EPIPOLE_FIXTURES", Path(__file__).parents[2] / "fixtures"))


@pytest.fixture(scope="session")
def pair():
    """A rectified pair."""
    return tuple(epipole.read_image(FIXTURES / "stereo" / f"{side}.jpg") for side in ("left", "right"))


@pytest.fixture(scope="session")
def stereo_truth():
    """Focal length in px, baseline in meters, true disparity, and the mask of the pixels visible in both views."""
    known = json.loads((FIXTURES / "oracle" / "stereo.json").read_text())
    disparity = epipole.read_map(FIXTURES / "oracle" / "stereo-disparity.png")
    visible = epipole.read_image(FIXTURES / "oracle" / "stereo-visible.png") > 0
    return known["focal_px"], known["baseline_m"], disparity, visible


@pytest.fixture(scope="session")
def plane():
    """Two photographs of a plane, and the true homography."""
    known = json.loads((FIXTURES / "oracle" / "plane.json").read_text())
    photos = tuple(epipole.read_image(FIXTURES / "plane" / f"{name}.jpg") for name in "ab")
    return *photos, np.array(known["homography"])
