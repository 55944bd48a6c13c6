"""A session: a folder of captures (trials) that share cameras, the empty scene and settings.

    SESSION/session.toml       marks it; the keys of `capture.toml`, defaults of all trials; it may be empty
    SESSION/calibration.toml   of trials without one
    SESSION/background/        of trials without one
    SESSION/TRIAL/             a capture

Only the parent folder counts, and only with `session.toml`, so that nothing is inherited by accident. What a trial has
itself wins.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tk.errors import CaptureError
from tk.io.toml import load_toml, shown

#: the file that marks a session
SESSION = "session.toml"

#: keys that describe one recording, not a session
_OF_A_TRIAL = ("name", "videos", "background")

#: tables whose keys are inherited one by one; others are inherited as a whole
_BY_KEY = ("subject", "init")

#: files that these tables name, relative to the folder of their file
_FILES = {"subject": ("body", "init"), "init": ("keypoints",)}

#: folders that make a folder below a session a trial
_IMAGES = ("videos", "images")


def session_of(capture: Path) -> Path | None:
    """Return the session that a capture is in; None if it is in none."""
    folder = capture.resolve().parent
    return folder if (folder / SESSION).is_file() else None


def inherited(capture: Path, part: str) -> Path:
    """Return a file or folder of a capture, or of its session if only this has it."""
    session = session_of(capture)
    if session is None or (capture / part).exists() or not (session / part).exists():
        return capture / part
    return session / part


def trials(folder: Path) -> list[Path]:
    """Return the captures in a session, sorted by name.

    Raises:
        CaptureError: there are none.
    """
    found = [path for path in sorted(folder.iterdir()) if path.is_dir() and _is_trial(path)]
    if not found:
        raise CaptureError(f"{folder}: is a session ({SESSION}) without trials: no folder in it has videos/ or images/")
    return found


def is_session(folder: Path) -> bool:
    """Return whether a folder is a session, and no capture itself."""
    return (folder / SESSION).is_file() and not _is_trial(folder)


def _is_trial(folder: Path) -> bool:
    if any((folder / name).is_dir() for name in _IMAGES):
        return True
    try:
        return "videos" in load_toml(folder / "capture.toml")
    except CaptureError:
        return False


def merged(capture: Path, own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a capture's `capture.toml` with what its session adds.

    Raises:
        CaptureError: the session's file cannot be read, or has keys that describe one recording.
    """
    session = session_of(capture)
    if session is None:
        return dict(own)
    given = load_toml(session / SESSION)
    if wrong := [key for key in _OF_A_TRIAL if key in given]:
        raise CaptureError(f"{session / SESSION}: {wrong[0]} belongs to one trial: write it to its capture.toml")
    document = {key: _located(key, value) for key, value in given.items()}
    for key, value in own.items():
        default = document.get(key)
        by_key = key in _BY_KEY and isinstance(default, Mapping) and isinstance(value, Mapping)
        document[key] = {**default, **value} if by_key and isinstance(default, Mapping) else value
    return document


def described(capture: Path, own: Mapping[str, Any]) -> list[str]:
    """Return the note about what a capture inherits, if it does."""
    session = session_of(capture)
    if session is None:
        return []
    parts = [part for part in ("calibration.toml", "background") if inherited(capture, part).parent == session]
    values = merged(capture, own)
    settings = [key for key, value in values.items() if value != own.get(key)]
    listed = [*parts, *(f"{key} = {shown(values[key])}" for key in settings)]
    return [f"{capture}: inherited from the session {session}: {', '.join(listed)}"] if listed else []


def _located(key: str, value: Any) -> Any:
    """Return a value of a session's file with its files relative to a trial."""
    if isinstance(value, list):
        return [_located(key, item) if isinstance(item, Mapping) else item for item in value]
    if not isinstance(value, Mapping):
        return value
    return {
        name: f"../{item}" if name in _FILES.get(key, ()) and isinstance(item, str) and not Path(item).is_absolute()
        else item
        for name, item in value.items()
    }  # fmt: skip
