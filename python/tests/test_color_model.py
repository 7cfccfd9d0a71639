"""Segmentation of the ball in the generated photographs; the model as an estimator of scikit-learn."""

import pickle

import epipole
import numpy as np
import pytest
from conftest import FIXTURES
from epipole import errors


@pytest.fixture(scope="module")
def balls():
    photographs = [epipole.read_image(FIXTURES / "ball" / f"ball{i}.jpg") for i in range(8)]
    folder = FIXTURES / "oracle" / "ball-masks"
    masks = [epipole.read_image(path) > 127 for path in sorted(folder.iterdir())]
    return photographs, masks


@pytest.fixture(scope="module")
def fitted(balls):
    photographs, masks = balls
    return epipole.ColorModel().fit(photographs[::2], masks[::2])


def test_the_ball_is_segmented_in_other_photographs(balls, fitted):
    photographs, masks = (part[1::2] for part in balls)
    # The target for generated scenes.
    assert fitted.score(photographs, masks) >= 0.97
    found = fitted.predict(photographs)
    assert all(f.dtype == bool and f.shape == m.shape for f, m in zip(found, masks))
    assert np.array_equal(found[0], fitted.predict(photographs[0]))
    for photograph, mask in zip(photographs, masks):
        likely = fitted.predict_proba(photograph)
        # Pixels on the object's boundary blend object and background.
        assert likely.dtype == np.float32 and likely[mask].mean() > 0.8 > 0.1 > likely[~mask].mean()
        best = fitted.locate(photograph).objects[0]
        y, x = np.nonzero(mask)
        assert best.found and np.hypot(best.center[0] - x.mean(), best.center[1] - y.mean()) < 1
    scores = epipole.evaluate_mask(found[0], masks[0])
    both = (found[0] & masks[0]).sum()
    assert scores["true_positives"] == both and scores["iou"] == pytest.approx(both / (found[0] | masks[0]).sum())


def test_a_model_is_saved_pickled_and_cloned(balls, fitted, tmp_path):
    photograph = balls[0][1]
    fitted.save(tmp_path / "ball.json")
    for again in (epipole.ColorModel.load(tmp_path / "ball.json"), pickle.loads(pickle.dumps(fitted))):
        assert np.array_equal(again.predict(photograph), fitted.predict(photograph))
    assert fitted.get_params()["components"] == 5 and "fitted on 4" in repr(fitted)
    assert fitted.set_params(seed=1) is fitted
    with pytest.raises(ValueError, match="colour"):
        fitted.set_params(colour="red")


def test_the_model_is_a_scikit_learn_estimator(balls):
    sklearn = pytest.importorskip("sklearn")
    from sklearn.base import clone, is_classifier
    from sklearn.exceptions import NotFittedError
    from sklearn.pipeline import Pipeline

    photographs, masks = balls
    model = clone(epipole.ColorModel(components=3))
    assert model.components == 3 and is_classifier(model) and sklearn
    with pytest.raises(NotFittedError):
        model.predict(photographs)
    pipeline = Pipeline([("ball", model)])
    pipeline.set_params(ball__components=4).fit(photographs[::2], masks[::2])
    assert pipeline.named_steps["ball"].components == 4 and pipeline.score(photographs[1::2], masks[1::2]) > 0.95


def test_invalid_training_input_is_refused(balls):
    photographs, masks = balls
    empty = [np.zeros_like(m) for m in masks[:2]]
    with pytest.raises(errors.NoForegroundError) as refused:
        epipole.ColorModel().fit(photographs[:2], empty)
    assert refused.value.photos == 2
    with pytest.raises(errors.SizeMismatchError):
        epipole.ColorModel().fit(photographs[:1], [masks[0][:-1]])
    with pytest.raises(ValueError, match="masks"):
        epipole.ColorModel().fit(photographs, masks[:1])
    with pytest.raises(errors.OptionError):
        epipole.ColorModel(components=0).fit(photographs[:1], masks[:1])
    with pytest.raises(ValueError, match="hsl"):
        epipole.ColorModel(space="hsl").fit(photographs[:1], masks[:1])
    with pytest.raises(ValueError):
        epipole.ColorModel().predict(photographs[0])
