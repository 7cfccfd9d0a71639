"""The signatures of the stub are those of the functions."""

import ast
from pathlib import Path

import epipole
import pytest

STUB = ast.parse((Path(epipole.__file__).parent / "_native.pyi").read_text())


def options(function):
    """Returns the keyword-only arguments of the stub and their defaults."""
    for node in STUB.body:
        if isinstance(node, ast.ClassDef) and node.name == function:
            node = next(n for n in node.body if getattr(n, "name", "") == "__new__")
        elif not (isinstance(node, ast.FunctionDef) and node.name == function):
            continue
        values = [eval(compile(ast.Expression(d), "stub", "eval")) for d in node.args.kw_defaults]
        return {a.arg: v for a, v in zip(node.args.kwonlyargs, values)}
    raise AssertionError(f"the stub lacks {function}")


@pytest.mark.parametrize(
    "function",
    [
        "StereoMatcher",
        "Undistorter",
        "calibrate",
        "depth",
        "estimate_essential",
        "estimate_fundamental",
        "estimate_homography",
        "estimate_pose",
        "extract_features",
        "find_board",
        "match",
        "match_features",
        "panorama",
        "reconstruct",
        "rectify",
        "sfm",
        "sfm_features",
        "undistort",
    ],
)
def test_options_and_defaults_of_the_stub(function):
    assert options(function) == pytest.approx(epipole.defaults(function))


def test_the_stub_has_all_public_names():
    there = {node.name for node in STUB.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
    there = {name for name in there if not name.startswith("_")}
    own = {"AprilGrid", "ArucoGrid", "CharucoBoard", "Chessboard", "ColorModel", "Features", "PointCloud", "Reconstruction"}
    public = {name for name in epipole.__all__ if name not in ("errors", "boards", "__version__")}
    # Internal classes and functions of the Python wrappers.
    assert there - {"FittedColorModel", "PairDepth", "read_model", "write_model"} == public - own
    for name in epipole.__all__:
        assert hasattr(epipole, name)
    assert epipole.Depth.__name__ == "Depth" and epipole.errors.EpipoleError
    with pytest.raises(AttributeError):
        epipole.nothing


def test_the_options_of_the_color_model_are_those_of_the_library():
    assert epipole.ColorModel().get_params() == epipole.defaults("ColorModel")
    assert epipole.boards.CharucoBoard((7, 5), 35, 26).dictionary == epipole.ArucoGrid((3, 4), 20).dictionary
