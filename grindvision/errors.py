"""Every error this package raises on purpose: its message names what was wrong, the value seen, and what to do."""


class GrindvisionError(Exception):
    """Base of all errors of this package. The command line turns it into one line on stderr and exit code 2."""


class GrindvisionWarning(UserWarning):
    """Something the user should know, though the result stands."""


class InputError(GrindvisionError):
    """An argument, file or table cannot be used as it is."""


class FileError(InputError):
    """A file is missing, damaged, of an unknown format, or cannot be written."""


class UnitError(InputError):
    """Numbers look like another unit than the one stated (metres for millimetres, degrees for radians)."""


class NotRigidError(InputError):
    """A 4x4 matrix is not a rigid transform."""


class DegenerateError(GrindvisionError):
    """The data do not determine the answer: too few points, collinear points, a free motion."""


class AmbiguousError(DegenerateError):
    """Several answers fit the data alike; the message names the motion between them."""


class TooSmallError(DegenerateError):
    """A bead shows too few points to be followed."""


class UnreachableError(GrindvisionError):
    """No joint angles reach the pose asked for."""


class SightError(InputError):
    """A scanner's pose shows it nothing, or nothing within its measuring range."""


class CollisionError(GrindvisionError):
    """Arm, tool, work and table would touch, or the work lies where no tool can get."""


class SendError(GrindvisionError):
    """A programme could not be handed over to the robot's controller."""


class NoGrooveError(GrindvisionError):
    """The cloud shows no weld groove."""


class MissingExtraError(GrindvisionError, ImportError):
    """A package of one of grindvision's extras is not installed; the message holds the ``pip install`` line."""
