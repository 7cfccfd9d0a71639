"""The examples of the docstrings give the stated results."""

import doctest
import inspect

import epipole
import numpy as np
import pytest
from epipole import boards, errors

# Functions with an example in their docstring. Functions of files or photographs are in the guides, which are tested as well.
SHOWN = {
    "Camera",
    "ColorModel",
    "StereoMatcher",
    "defaults",
    "depth",
    "estimate_homography",
    "estimate_pose",
    "evaluate_disparity",
    "evaluate_mask",
    "extract_features",
    "find_board",
    "is_borrowed",
    "match",
    "match_features",
    "undistort",
}


def documented():
    """Returns all public objects with a docstring, by name."""
    found = {"epipole": epipole, "epipole.boards": boards, "epipole.errors": errors}
    for name in epipole.__all__:
        thing = getattr(epipole, name)
        found[name] = thing
        if inspect.isclass(thing):
            members = {f"{name}.{member}": value for member, value in vars(thing).items() if not member.startswith("_")}
            found.update(members)
    return {name: thing.__doc__ for name, thing in found.items() if isinstance(getattr(thing, "__doc__", None), str)}


EXAMPLES = {name: text for name, text in documented().items() if ">>>" in text}


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_an_example_gives_the_stated_result(name):
    shown = {"epipole": epipole, "np": np}
    test = doctest.DocTestParser().get_doctest(EXAMPLES[name], shown, name, None, None)
    said = []
    results = doctest.DocTestRunner().run(test, out=said.append)
    assert results.attempted >= 1 and results.failed == 0, "".join(said)


def test_the_listed_objects_have_an_example():
    assert SHOWN <= set(EXAMPLES)
