"""What cannot be done, with its numbers as attributes.

The attributes are those of the refusal: ``NotEnoughMatchesError`` has ``got`` and ``needed``. ``kind`` is the name of the refusal, of which there are more than
classes here.
"""


class EpipoleError(Exception):
    """The job could not be done."""

    kind = ""

    def __init__(self, message, kind="", **numbers):
        super().__init__(message)
        self.kind = kind
        self.__dict__.update(numbers)

    def __reduce__(self):
        return _again, (type(self), str(self), dict(self.__dict__))


class FileError(EpipoleError, OSError):
    """A file cannot be read or written. ``path``."""


class OptionError(EpipoleError, ValueError):
    """An option is out of its range. ``name``, ``value``, ``range``."""


class ShapeError(EpipoleError, ValueError):
    """An array has the wrong shape. ``shape``."""


class ImageMismatchError(EpipoleError, ValueError):
    """Two images differ in type or channels. ``left``, ``right``: their shapes."""


class SizeMismatchError(EpipoleError, ValueError):
    """Two images or maps differ in size."""


class NoPairError(EpipoleError):
    """Hardly any pixel of one photograph has a partner in the other. ``matched``, ``needed``, ``cause``."""


class NoDepthError(EpipoleError):
    """No disparity has a depth that is kept. ``kept``, ``found``."""


class NotEnoughMatchesError(EpipoleError):
    """There are fewer matches than the model has need of. ``got``, ``needed``."""


class NotFiniteError(EpipoleError, ValueError):
    """A coordinate or sample is NaN or infinite."""


class DegenerateError(EpipoleError):
    """The input determines no model. ``in_which_way``: Coincident, Collinear or Planar."""


class NoConsensusError(EpipoleError):
    """As many matches would agree if all were wrong. ``inliers``, ``matches``, ``needed``, ``iterations``."""


class NoFeaturesError(EpipoleError):
    """A photograph has no features. ``index``, ``found``, ``dropped``."""


class ImageTooSmallError(EpipoleError, ValueError):
    """A photograph is smaller than what is looked for."""


class InternalError(RuntimeError):
    """A mistake of this package."""


def _again(cls, message, state):
    error = cls(message)
    error.__dict__.update(state)
    return error


def _made(variants, message, numbers):
    """The exception of the innermost refusal that has a class."""
    # A class has a name of its own.
    if "kind" in numbers:
        numbers["in_which_way"] = numbers.pop("kind")
    for variant in reversed(variants):
        cls = globals().get(variant + "Error")
        if cls is not None:
            return cls(message, variant, **numbers)
    return EpipoleError(message, variants[-1] if variants else "", **numbers)
