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


class ImageSizeError(EpipoleError, ValueError):
    """A photograph has another size than its camera. ``image``, ``expected``."""


class CameraSizeError(ImageSizeError):
    """The same of photographs of a reconstruction. ``camera``, ``photo``."""


class BoardNotFoundError(EpipoleError):
    """The calibration board is not on the photograph: ``kind`` and the numbers say what is."""


class NoBoardError(BoardNotFoundError):
    """Nothing is a chessboard. ``corners``."""


class NoMarkersError(BoardNotFoundError):
    """No marker of the board can be read. ``dictionary``, ``seen``."""


class OtherDictionaryError(BoardNotFoundError):
    """The markers are of another dictionary. ``seen``, ``asked``."""


class MirroredError(BoardNotFoundError):
    """The board is mirrored."""


class OtherLayoutError(BoardNotFoundError):
    """The markers lie otherwise."""


class OtherSizeError(BoardNotFoundError):
    """There is a chessboard of another size."""


class PartialError(BoardNotFoundError):
    """Only a part of the chessboard is seen."""


class SeveralBoardsError(BoardNotFoundError):
    """There are several boards."""


class NoBoardsError(EpipoleError):
    """No photograph shows the board. ``refusals``: why, by view and camera."""


class TooFewViewsError(EpipoleError):
    """A camera has too few views of the board. ``camera``, ``got``, ``needed``."""


class TooFewMatchesError(EpipoleError):
    """There are too few matches between two photographs. ``got``, ``needed``."""


class TooFewInliersError(EpipoleError):
    """Too few matches agree on a motion of the camera."""


class PureRotationError(EpipoleError):
    """The camera only turned: there is no depth to be seen."""


class PlanarError(EpipoleError):
    """All that agrees lies on a plane."""


class LittleParallaxError(EpipoleError):
    """The camera moved too little for depth."""


class UncertainPoseError(EpipoleError):
    """The motion is not determined well enough."""


class WrongFocalError(EpipoleError, ValueError):
    """The focal length that was given contradicts the matches."""


class ImplausibleFocalError(EpipoleError):
    """The matches lead to a focal length that photographs do not have."""


class NoPairsError(EpipoleError):
    """No two photographs show enough of the same. ``photos``."""


class TooFewPhotosError(EpipoleError, ValueError):
    """More photographs are needed. ``got``."""


class NoOverlapError(EpipoleError):
    """The photographs have nothing in common. ``images``: what became of each."""


class NoForegroundError(EpipoleError, ValueError):
    """No mask marks a pixel. ``photos``."""


class NoBackgroundError(EpipoleError, ValueError):
    """The masks mark every pixel. ``photos``."""


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
