"""Exceptions of failed jobs, with their numbers as attributes.

The attributes are those of the library's error: ``NotEnoughMatchesError`` has ``got`` and ``needed``. ``kind`` is the name of the library's error variant; there are more
variants than classes here.
"""


class EpipoleError(Exception):
    """A job could not be done."""

    kind = ""

    def __init__(self, message, kind="", **numbers):
        super().__init__(message)
        self.kind = kind
        self.__dict__.update(numbers)

    def __reduce__(self):
        return _restore, (type(self), str(self), dict(self.__dict__))


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
    """Too few pixels were matched for a stereo pair. ``matched``, ``needed``, ``cause``."""


class NoDepthError(EpipoleError):
    """All depths are outside the range to keep. ``kept``, ``found``."""


class NotEnoughMatchesError(EpipoleError):
    """There are fewer matches than the model needs. ``got``, ``needed``."""


class NotFiniteError(EpipoleError, ValueError):
    """A coordinate or sample is NaN or infinite."""


class DegenerateError(EpipoleError):
    """The input is a degenerate configuration. ``in_which_way``: Coincident, Collinear or Planar."""


class NoConsensusError(EpipoleError):
    """The model has no more inliers than expected by chance. ``inliers``, ``matches``, ``needed``, ``iterations``."""


class NoFeaturesError(EpipoleError):
    """A photograph has no features. ``index``, ``found``, ``dropped``."""


class ImageTooSmallError(EpipoleError, ValueError):
    """An image is smaller than the method needs."""


class ImageSizeError(EpipoleError, ValueError):
    """A photograph has another size than its camera. ``image``, ``expected``."""


class CameraSizeError(ImageSizeError):
    """As ImageSizeError, for photographs of a reconstruction. ``camera``, ``photo``."""


class BoardNotFoundError(EpipoleError):
    """The calibration board was not detected; ``kind`` and the numbers describe what was."""


class NoBoardError(BoardNotFoundError):
    """No chessboard was detected. ``corners``."""


class NoMarkersError(BoardNotFoundError):
    """No marker of the board can be read. ``dictionary``, ``seen``."""


class OtherDictionaryError(BoardNotFoundError):
    """The markers are of another dictionary. ``seen``, ``asked``."""


class MirroredError(BoardNotFoundError):
    """The board is mirrored."""


class OtherLayoutError(BoardNotFoundError):
    """The markers are in another layout."""


class OtherSizeError(BoardNotFoundError):
    """A chessboard of another size was detected."""


class PartialError(BoardNotFoundError):
    """Only a part of the chessboard is visible."""


class SeveralBoardsError(BoardNotFoundError):
    """Several boards were detected."""


class NoBoardsError(EpipoleError):
    """The board was not detected on any photograph. ``refusals``: reasons by view and camera."""


class TooFewViewsError(EpipoleError):
    """A camera has too few views of the board. ``camera``, ``got``, ``needed``."""


class TooFewMatchesError(EpipoleError):
    """There are too few matches between two photographs. ``got``, ``needed``."""


class TooFewInliersError(EpipoleError):
    """The relative pose has too few inliers."""


class PureRotationError(EpipoleError):
    """The motion is a pure rotation, which gives no depth."""


class PlanarError(EpipoleError):
    """All inliers lie on a plane: a degenerate configuration."""


class LittleParallaxError(EpipoleError):
    """The baseline is too small for depth."""


class UncertainPoseError(EpipoleError):
    """The relative pose is too uncertain."""


class WrongFocalError(EpipoleError, ValueError):
    """The given focal length contradicts the matches."""


class ImplausibleFocalError(EpipoleError):
    """The self-calibrated focal length is implausible."""


class NoPairsError(EpipoleError):
    """No two photographs have enough overlap. ``photos``."""


class TooFewPhotosError(EpipoleError, ValueError):
    """More photographs are needed. ``got``."""


class NoOverlapError(EpipoleError):
    """No two photographs overlap. ``images``: the outcome of each."""


class NoForegroundError(EpipoleError, ValueError):
    """No mask marks a pixel. ``photos``."""


class NoBackgroundError(EpipoleError, ValueError):
    """The masks mark every pixel. ``photos``."""


class InternalError(RuntimeError):
    """A bug of this package."""


def _restore(cls, message, state):
    error = cls(message)
    error.__dict__.update(state)
    return error


def _made(variants, message, numbers):
    """Makes the exception of the innermost error variant that has a class."""
    # ``kind`` is reserved for the name of the variant.
    if "kind" in numbers:
        numbers["in_which_way"] = numbers.pop("kind")
    for variant in reversed(variants):
        cls = globals().get(variant + "Error")
        if cls is not None:
            return cls(message, variant, **numbers)
    return EpipoleError(message, variants[-1] if variants else "", **numbers)
