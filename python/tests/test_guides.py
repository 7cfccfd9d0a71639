"""The blocks of the guides and the cells of the notebooks run on generated photographs, and pass strict type checking."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import epipole
import numpy as np
import pytest
import scenes
from conftest import FIXTURES

ROOT = Path(__file__).parents[1]
NEEDS = {"from-cv2.md": ["cv2"], "cluster.md": ["ray", "daft"]}


@pytest.fixture(scope="session")
def photographs(tmp_path_factory):
    """The working folder of the guides: the fixtures, and twelve photographs of a chessboard."""
    folder = tmp_path_factory.mktemp("guides")
    for part in ("stereo", "plane", "panorama", "ball", "two-view", "oracle/ball-masks"):
        for path in (FIXTURES / part).iterdir():
            shutil.copy(path, folder / (path.name if part != "two-view" else f"two-{path.name}"))
    random = np.random.default_rng(3)
    board = [((0, 0, 0), np.eye(3)[0], np.eye(3)[1], scenes.chessboard(8, 5, 0.034))]
    matrix = np.array([[420.0, 0, 163.0], [0, 418.0, 117.0], [0, 0, 1]])
    for i in range(12):
        tilt = scenes.rotation(*random.uniform(-0.45, 0.45, 3))
        middle = np.array([*random.uniform(-0.03, 0.03, 2), random.uniform(0.7, 0.85)])
        pose = tilt, middle - tilt @ np.array([3.5 * 0.034, 2 * 0.034, 0])
        epipole.write_image(folder / f"board{i:02}.png", scenes.render(board, matrix, pose, (320, 240))[0])
    for i, image in enumerate(scenes.walk()):
        epipole.write_image(folder / f"walk{i}.png", image)
    return folder


def program(path):
    """Returns the code of a guide or a notebook as one program."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text())["cells"]
        return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code") + "\n"
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text(), re.M | re.S))


GUIDES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "notebooks").glob("*.ipynb"))]


def marked(path):
    """Returns the parameter of a test of a guide; those that need Ray start a cluster."""
    return pytest.param(path, id=path.name, marks=[pytest.mark.cluster] if "ray" in NEEDS.get(path.name, []) else [])


@pytest.mark.parametrize("path", [marked(path) for path in GUIDES])
def test_a_guide_runs(path, photographs, tmp_path):
    for module in NEEDS.get(path.name, []):
        pytest.importorskip(module)
    text = program(path)
    assert text.count("\n") > 3
    folder = tmp_path / "photographs"
    shutil.copytree(photographs, folder)
    script = tmp_path / f"{path.stem.replace('-', '_')}.py"
    script.write_text(text)
    environment = {**os.environ, "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "DO_NOT_TRACK": "1", "PYTHONWARNINGS": "ignore"}
    # In the system's temporary folder, since paths of Unix sockets have at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="ray") as sessions:
        # A killed cluster leaves its address file: here with port 1, on which nothing listens.
        Path(sessions, "ray").mkdir()
        Path(sessions, "ray", "ray_current_cluster").write_text("127.0.0.1:1")
        environment["RAY_TMPDIR"] = sessions
        ran = subprocess.run([sys.executable, script], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr[-3000:]


def test_examples_satisfy_pyright(tmp_path):
    pytest.importorskip("pyright")
    paths = [path for path in GUIDES if path.name not in NEEDS]
    for path in paths:
        (tmp_path / f"{path.stem.replace('-', '_')}.py").write_text(program(path))
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"typeCheckingMode": "strict"}))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "-p", tmp_path]
    checked = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert checked.returncode == 0, checked.stdout[-3000:] + checked.stderr[-1000:]


def test_the_stub_is_that_of_the_library():
    pytest.importorskip("mypy")
    # Completeness is tested with the options.
    command = [sys.executable, "-m", "mypy.stubtest", "epipole._native", "--ignore-missing-stub"]
    checked = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert checked.returncode == 0, checked.stdout[-3000:] + checked.stderr[-1000:]
