"""What a user did wrong, in one line.

Every message names the file (or option) and the fix. The command line prints it and exits with 2;
anything that is not a :class:`TkError` is a defect of ours and keeps its traceback.
"""


class TkError(Exception):
    """Base of all errors that a user can mend."""


class CaptureError(TkError):
    """A capture folder, or a file in it, cannot be used."""


class CalibrationError(CaptureError):
    """`calibration.toml` is missing, unreadable, or describes an impossible camera."""


class VideoError(CaptureError):
    """A video, image sequence or mask cannot be read."""


class VolumeError(CaptureError):
    """The working volume is empty or out of the cameras' sight."""


class ResultError(TkError):
    """A result file cannot be written, read or continued."""


class ResultBusyError(ResultError):
    """Another run is writing the result."""


class ExportError(TkError):
    """A result cannot be written in another format."""


class DisplayError(TkError):
    """There is no display to show something on, or nothing that can draw on it."""


class ConfigError(TkError):
    """A configuration value or command-line option is out of range."""


class WorkerError(TkError):
    """A process that worked for this one has been killed."""
