"""Color segmentation with the interface of scikit-learn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

import numpy as np

from epipole import _native

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from epipole._results import Located

    # uint8; the type of an array from a reader is only known at run time.
    _Image = NDArray[Any]
    _Mask = NDArray[np.bool_] | NDArray[np.uint8]

_Found = TypeVar("_Found")


class ColorModel:
    """Gaussian mixture models of the colors of an object and of the background; pixels are classified by posterior odds.

    Photographs are arrays of uint8, masks arrays of bool or uint8 of the same height and width. As a scikit-learn estimator, it takes lists of them: ``fit(photographs, masks)``,
    ``predict(photographs)``, ``score(photographs, masks)`` (F1); ``get_params``, ``set_params`` and ``clone`` work. Fitted attributes end in ``_``.

    Options: ``defaults("ColorModel")``.

    >>> random = np.random.default_rng(0)
    >>> mask = np.zeros((40, 60), bool)
    >>> mask[10:30, 20:40] = True
    >>> photograph = (np.where(mask[..., None], [220, 120, 30], [40, 90, 160]) + random.integers(0, 12, (40, 60, 3))).astype(np.uint8)
    >>> model = epipole.ColorModel().fit([photograph], [mask])
    >>> model.score([photograph], [mask]) > 0.98
    True
    """

    def __init__(
        self,
        *,
        space: Literal["hsv", "rgb", "lab"] = "hsv",
        components: int = 5,
        background_components: int = 10,
        rule: Literal["tuned", "posterior", "density"] = "tuned",
        unknown: float = 0.01,
        smoothing: float = 1.0,
        regularization: float = 1e-6,
        open_radius: int = 2,
        close_radius: int = 2,
        regions: Literal["auto", "largest", "all"] = "auto",
        seed: int = 1,
        threads: int | None = None,
        progress: Callable[[str, int, int], object] | None = None,
    ) -> None:
        self.space = space
        self.components = components
        self.background_components = background_components
        self.rule = rule
        self.unknown = unknown
        self.smoothing = smoothing
        self.regularization = regularization
        self.open_radius = open_radius
        self.close_radius = close_radius
        self.regions = regions
        self.seed = seed
        self.threads = threads
        self.progress = progress

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Returns the options by name."""
        return {name: getattr(self, name) for name in self._names()}

    def set_params(self, **options: Any) -> ColorModel:
        """Sets options; the model must be fitted again."""
        for name, value in options.items():
            if name not in self._names():
                raise ValueError(f"ColorModel has no option {name!r}; there are {', '.join(self._names())}")
            setattr(self, name, value)
        return self

    @classmethod
    def _names(cls) -> dict[str, Any]:
        return cls.__init__.__kwdefaults__ or {}

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import ClassifierTags, InputTags, Tags, TargetTags

        input_tags = InputTags(two_d_array=False, three_d_array=True)
        tags = {"estimator_type": "classifier", "classifier_tags": ClassifierTags(multi_class=False)}
        return Tags(target_tags=TargetTags(required=True), input_tags=input_tags, transformer_tags=None, regressor_tags=None, **tags)

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "fitted_")

    def __repr__(self) -> str:
        changed = {name: getattr(self, name) for name, value in self._names().items() if getattr(self, name) != value}
        options = ", ".join(f"{name}={value!r}" for name, value in changed.items())
        fitted = f": fitted on {len(self.scores_)} photographs" if hasattr(self, "scores_") else ""
        return f"ColorModel({options}){fitted}"

    def fit(self, photographs: Sequence[_Image], masks: Sequence[_Mask]) -> ColorModel:
        """Fits the color models. ``scores_`` are training scores; those on other photographs are lower."""
        self.fitted_, self.scores_ = _native.FittedColorModel.fit(photographs, masks, **self.get_params())
        self.classes_ = np.array([False, True])
        return self

    @overload
    def predict(self, photographs: _Image) -> NDArray[np.bool_]: ...
    @overload
    def predict(self, photographs: Sequence[_Image]) -> list[NDArray[np.bool_]]: ...
    def predict(self, photographs: Any) -> Any:
        """Returns the masks of the object after morphological clean-up, for a photograph or a list of them."""
        return self._each(self._fitted().predict, photographs)

    @overload
    def predict_proba(self, photographs: _Image) -> NDArray[np.float32]: ...
    @overload
    def predict_proba(self, photographs: Sequence[_Image]) -> list[NDArray[np.float32]]: ...
    def predict_proba(self, photographs: Any) -> Any:
        """Returns the posterior probability of the object at each pixel, float32, for a photograph or a list of them.

        Pixels above ``threshold_`` form the mask before clean-up.
        """
        return self._each(lambda photograph: _sigmoid(self._fitted().log_odds(photograph)), photographs)

    @overload
    def decision_function(self, photographs: _Image) -> NDArray[np.float32]: ...
    @overload
    def decision_function(self, photographs: Sequence[_Image]) -> list[NDArray[np.float32]]: ...
    def decision_function(self, photographs: Any) -> Any:
        """Returns the log posterior odds at each pixel, float32."""
        return self._each(self._fitted().log_odds, photographs)

    def score(self, photographs: Sequence[_Image], masks: Sequence[_Mask]) -> float:
        """Returns F1 over all pixels of all photographs."""
        counts = [_native.evaluate_mask(self.predict(p), m) for p, m in zip(photographs, masks, strict=True)]
        true_positives, false_positives = (sum(c[name] for c in counts) for name in ("true_positives", "false_positives"))
        false_negatives = sum(c["false_negatives"] for c in counts)
        return 2 * true_positives / max(2 * true_positives + false_positives + false_negatives, 1)

    def locate(self, photograph: _Image, *, min_score: float | None = None) -> Located:
        """Detects the object: regions of its color, scored by color and shape."""
        return self._fitted().locate(photograph, min_score=min_score)

    @property
    def threshold_(self) -> float:
        """Posterior probability above which a pixel belongs to the object."""
        return float(_sigmoid(np.float32(self._fitted().threshold)))

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the JSON model of ``cv segment``."""
        with open(path, "w", encoding="utf-8") as file:
            file.write(self._fitted().to_json())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> ColorModel:
        """Reads a model written by ``save`` or ``cv segment train``."""
        model = cls()
        with open(path, encoding="utf-8") as file:
            model.fitted_ = _native.FittedColorModel.from_json(file.read())
        model.classes_ = np.array([False, True])
        return model

    def _fitted(self) -> _native.FittedColorModel:
        if not hasattr(self, "fitted_"):
            raise _not_fitted()
        return self.fitted_

    @staticmethod
    def _each(work: Callable[[Any], _Found], photographs: Any) -> Any:
        if hasattr(photographs, "ndim") and photographs.ndim in (2, 3):
            return work(photographs)
        return [work(photograph) for photograph in photographs]


_BLOCK_ROWS = 256


def _sigmoid(log_odds: Any) -> Any:
    """Returns 1 / (1 + exp(-x)) in float32, by blocks of rows: between them, Ctrl-C is handled, and float64 copies stay small."""
    odds = np.atleast_1d(log_odds)
    probability = np.empty(odds.shape, np.float32)
    # exp overflows to infinity below -709, and the quotient is 0.
    with np.errstate(over="ignore"):
        for row in range(0, len(odds), _BLOCK_ROWS):
            rows = slice(row, row + _BLOCK_ROWS)
            probability[rows] = 1.0 / (1.0 + np.exp(-odds[rows].astype(np.float64)))
    return probability.reshape(np.shape(log_odds))


def _not_fitted() -> Exception:
    message = "this ColorModel is not fitted yet: call fit with photographs and masks"
    try:
        from sklearn.exceptions import NotFittedError
    except ImportError:
        return ValueError(message)
    return NotFittedError(message)
