"""Errors that a user can correct.

Every message is one line that names the file or the option, and the remedy. The command line prints it, followed by
the hint, and exits with the error's ``exit_code``. Any other exception is a defect of the program and keeps its
traceback. Wherever files of users are read or written, one of these errors may occur; docstrings list them only where
the interface is public or a caller handles them.
"""

import errno

#: numbers of system errors for a disk, a quota or a file size that is used up
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class TkError(Exception):
    """Base of all errors that a user can correct.

    Attributes:
        exit_code: exit code of the command.
        hint: what to type on the command line; no part of the message, because scripts have no such options.
    """

    exit_code = 2

    def __init__(self, message: str = "", hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint

    @property
    def line(self) -> str:
        """The message and the hint in one line."""
        return " ".join((f"{self}; {self.hint}" if self.hint else str(self)).split())


class CaptureError(TkError):
    """A capture folder, or a file in it, cannot be used."""


class CalibrationError(CaptureError):
    """`calibration.toml` is missing, unreadable, or describes an impossible camera."""


class VideoError(CaptureError):
    """A video, image sequence or mask cannot be read."""


class VolumeError(CaptureError):
    """The working volume is empty, or the cameras do not see it."""


class ClockError(CaptureError):
    """The cameras were not recorded at the same times, or `fps` contradicts the videos."""


class ResultError(TkError):
    """A result file cannot be written, read or continued."""


class ResultBusyError(ResultError):
    """Another run is writing the result."""


class DiskFullError(ResultError):
    """There is no space left for a file; what was written before is kept."""

    exit_code = 1


def unwritable(path: object, error: OSError, kind: type[TkError] = ResultError) -> TkError:
    """Return the error of a file that the system cannot write: DiskFullError without space, else ``kind``."""
    reason = error.strerror or " ".join(str(error).split())
    return (DiskFullError if error.errno in FULL else kind)(f"{path}: cannot be written: {reason}")


class ExportError(TkError):
    """A result cannot be written in another format."""


class DisplayError(TkError):
    """There is no display, or no driver that can draw on it."""


class ConfigError(TkError):
    """A configuration value or command-line option is out of range."""


class WorkerError(TkError):
    """A worker process has been killed."""

    exit_code = 1
