"""Results of the jobs against ground truth; options; refused input."""

import pickle

import epipole
import numpy as np
import pytest
import scenes
from epipole import errors


def test_depth_of_a_generated_room(pair, stereo_truth):
    focal, baseline, truth, visible = stereo_truth
    found = epipole.depth(*pair, disparities=64, focal=focal, baseline=baseline, confidence=True)
    true_depth = focal * baseline / truth
    seen = visible & np.isfinite(true_depth) & (true_depth < 10)
    # The target: 95 % of the visible pixels within 5 %.
    assert (np.abs(found.depth - true_depth) <= 0.05 * true_depth)[seen].mean() >= 0.95
    assert found.matched.mean() == pytest.approx(found.matched_fraction)
    assert (found.confidence[found.matched] > 0).mean() > 0.9
    assert np.isfinite(found.disparity_deviation).all()
    scores = epipole.evaluate_disparity(found.disparity, truth, mask=visible)
    off = np.abs(found.disparity - truth)[visible & np.isfinite(truth)]
    # The threshold of 2 px, from the definition.
    assert scores["bad"][2] == pytest.approx(np.mean(~(off <= 2)), abs=1e-9)


def test_a_matcher_equals_depth_and_writes_to_the_given_array(pair):
    expected = epipole.depth(*pair, disparities=64).disparity
    matcher = epipole.StereoMatcher(disparities=64)
    assert np.array_equal(matcher.compute(*pair), expected, equal_nan=True)
    out = np.zeros_like(expected)
    assert matcher.compute(*pair, out=out) is out
    assert np.array_equal(out, expected, equal_nan=True)
    for wrong in (out[:-1], out.astype(np.float64), out.T.copy().T):
        with pytest.raises((TypeError, ValueError)):
            matcher.compute(*pair, out=wrong)
    locked = out.copy()
    locked.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        matcher.compute(*pair, out=locked)


@pytest.mark.parametrize("options", [{}, {"disparities": "auto"}, {"rig": True, "cloud": True}, {"focal": 300.0, "baseline": 0.2}])
def test_pairs_after_other_pairs_give_the_maps_of_depth(pair, options):
    height, width = pair[0].shape[:2]
    if "rig" in options:
        camera = epipole.Camera(width, height, [[300.0, 0, (width - 1) / 2], [0, 300.0, (height - 1) / 2], [0, 0, 1]])
        # The cameras are turned a little, so that the rectified images differ from the photographs.
        options = {**options, "rig": epipole.Rig(camera, camera, scenes.rotation(0, 0.01, 0), [-0.25, 0, 0])}
    options = {"disparities": 64, "threads": 1, **options}
    # Shifted down by 3 px, the second pair needs a correction that the others must not inherit; the third has another size if there is no rig.
    shifted = (pair[0], np.roll(pair[1], 3, axis=0))
    other = tuple(image[::-1].copy() for image in pair) if "rig" in options else tuple(image[20:].copy() for image in pair)
    matcher = epipole._native.PairDepth(**options)
    for left, right in (pair, shifted, other, pair):
        expected, found = epipole.depth(left, right, **options), matcher.compute(left, right)
        assert np.array_equal(found.disparity, expected.disparity, equal_nan=True)
        assert np.array_equal(found.state, expected.state)
        assert found.vertical_offset == expected.vertical_offset
        assert (found.depth is None) == (expected.depth is None)
        if found.depth is not None:
            assert np.array_equal(found.depth, expected.depth, equal_nan=True)
    with pytest.raises(errors.EpipoleError):
        matcher.compute(pair[0], np.random.default_rng(0).integers(0, 256, pair[0].shape, np.uint8))
    assert np.array_equal(matcher.compute(*pair).disparity, epipole.depth(*pair, **options).disparity, equal_nan=True)


def test_the_homography_of_a_plane(plane):
    a, b, truth = plane
    found = epipole.match_features(a, b)
    model = epipole.estimate_homography(found.points)
    height, width = a.shape[:2]
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]).T
    one, two = (h @ corners for h in (model.model, truth))
    # The target of the golden figures for the same pair.
    assert np.abs(one[:2] / one[2] - two[:2] / two[2]).max() < 0.3
    assert model.inliers.dtype == bool and model.inliers.sum() > 50
    first = found.keypoints[0][found.indices[:, 0], :2]
    assert np.allclose(first, found.points[:, :2])


def test_the_pose_of_an_exact_pair():
    random = np.random.default_rng(5)
    points = random.uniform([-2, -2, 4], [2, 2, 9], (80, 3))
    angle = 0.1
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    translation = np.array([1.0, 0.1, -0.05])
    k = np.array([[700.0, 0, 320], [0, 710.0, 240], [0, 0, 1]])

    def project(x):
        x = x @ k.T
        return x[:, :2] / x[:, 2:]

    matches = np.hstack([project(points), project(points @ rotation.T + translation)])
    # A fifth are outliers.
    matches[:16, 2:] += random.uniform(20, 60, (16, 2))
    found = epipole.estimate_essential(matches, k)
    assert np.allclose(found.rotation, rotation, atol=1e-6)
    assert np.allclose(found.translation, translation / np.linalg.norm(translation), atol=1e-6)
    assert found.inliers[16:].all() and found.inliers[:16].mean() < 0.2
    fundamental = epipole.estimate_fundamental(matches.tolist())
    a, b = (np.hstack([matches[16:, i : i + 2], np.ones((64, 1))]) for i in (0, 2))
    lines = a @ fundamental.model.T
    assert np.abs((b * lines).sum(1) / np.linalg.norm(lines[:, :2], axis=1)).max() < 1e-3
    with pytest.raises(ValueError, match="k1"):
        epipole.estimate_essential(matches, k.T)


def test_errors_have_their_numbers():
    with pytest.raises(errors.NotEnoughMatchesError) as refused:
        epipole.estimate_fundamental(np.zeros((5, 4)))
    assert refused.value.got == 5 and refused.value.needed in (7, 8) and refused.value.kind == "NotEnoughMatches"
    with pytest.raises(errors.DegenerateError) as refused:
        epipole.estimate_homography(np.repeat(np.arange(40.0)[:, None], 4, axis=1))
    assert refused.value.in_which_way == "Collinear"
    with pytest.raises(errors.NotFiniteError) as refused:
        epipole.estimate_homography(np.full((20, 4), np.nan))
    assert refused.value.index == 0
    with pytest.raises(errors.OptionError) as refused:
        epipole.estimate_homography(np.random.default_rng(1).random((20, 4)), confidence=1.5)
    assert (refused.value.name, refused.value.value) == ("confidence", 1.5)
    again = pickle.loads(pickle.dumps(refused.value))
    assert type(again) is errors.OptionError and again.value == 1.5 and str(again) == str(refused.value)
    with pytest.raises(errors.EpipoleError):
        epipole.estimate_homography(np.zeros((0, 4)))


def test_unrelated_images_and_unknown_geometry(pair):
    gray = np.full_like(pair[0], 90)
    with pytest.raises(errors.NoPairError) as refused:
        epipole.depth(gray, pair[1], disparities=64)
    assert refused.value.matched < refused.value.needed
    with pytest.raises(TypeError, match="together"):
        epipole.depth(*pair, focal=300.0)
    with pytest.raises(errors.EpipoleError):
        epipole.depth(*pair, focal=-300.0, baseline=1.0)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"disparites": 64}, TypeError, "did you mean 'disparities'"),
        ({"census": "6"}, ValueError, "5, 7, 9"),
        ({"census": True}, TypeError, "string"),
        ({"disparities": "many"}, ValueError, "auto"),
        ({"disparities": 64.5}, TypeError, "disparities"),
        ({"disparities": -1}, (TypeError, ValueError), "disparities"),
        ({"disparities": 0}, errors.EpipoleError, "disparities"),
        ({"p1": 300}, (TypeError, ValueError), "p1"),
        ({"threads": 0}, ValueError, "threads"),
        ({"progress": 3}, TypeError, "callable"),
        ({"nothing like it": 3}, TypeError, "unexpected"),
        # 100 GB.
        ({"disparities": 1 << 62}, errors.EpipoleError, "disparities"),
    ],
)
def test_options_are_checked(pair, options, error, words):
    with pytest.raises(error, match=words):
        epipole.depth(*pair, **options)


def test_options_have_the_librarys_defaults(pair):
    defaults = epipole.defaults("depth")
    assert defaults["disparities"] == 128 and defaults["census"] == "5" and defaults["threads"] is None
    assert epipole.defaults("estimate_essential")["threshold"] == 1.0
    # The documented default equals the behavior without the option.
    stereo = {k: v for k, v in epipole.defaults("StereoMatcher").items() if k not in ("threads", "progress")}
    a, b = epipole.StereoMatcher(**stereo), epipole.StereoMatcher()
    assert np.array_equal(a.compute(*pair), b.compute(*pair), equal_nan=True)
    with pytest.raises(ValueError, match="depth"):
        epipole.defaults("nothing")


def test_named_values_may_be_numbers(pair):
    a = epipole.depth(*pair, disparities=64, paths=4).disparity
    b = epipole.depth(*pair, disparities=64, paths="4").disparity
    assert np.array_equal(a, b, equal_nan=True)


def test_results_are_frozen_and_picklable(pair, plane):
    found = epipole.depth(*pair, disparities=64)
    with pytest.raises(AttributeError):
        found.disparity = None
    again = pickle.loads(pickle.dumps(found))
    assert np.array_equal(again.disparity, found.disparity, equal_nan=True)
    assert "px" in repr(found) and len(repr(found)) < 100
    assert "data:image/bmp" in found._repr_html_()
    matches = epipole.match_features(*plane[:2])
    assert str(len(matches)) in repr(matches) and "Model(" in repr(epipole.estimate_homography(matches.points))


def test_files_round_trip(tmp_path, pair):
    image = pair[0]
    for name, written in (("a.png", image), ("b.tif", image.astype(np.uint16) * 257), ("c.png", image[:, :, 0])):
        epipole.write_image(tmp_path / name, written)
        assert np.array_equal(epipole.read_image(tmp_path / name), written)
    values = np.array([[1.5, np.nan], [0.25, 3.0]], np.float32)
    for name in ("a.pfm", "a_kitti.png"):
        epipole.write_map(tmp_path / name, values)
        assert np.array_equal(epipole.read_map(tmp_path / name), values, equal_nan=True)
    with pytest.raises(FileNotFoundError) as missing:
        epipole.read_image(tmp_path / "missing.png")
    assert missing.value.filename.endswith("missing.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "a.png").read_bytes()[:300])
    with pytest.raises(errors.FileError) as cut:
        epipole.read_image(tmp_path / "cut.png")
    assert cut.value.path.endswith("cut.png")
    with pytest.raises(errors.FileError):
        epipole.write_image(tmp_path / "a.xyz", image)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pfm", "a.png", "a_kitti.png", "b.tif", "c.png", "cut.png"]
