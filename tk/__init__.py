"""Markerless motion capture from a few calibrated cameras: no markers, no GPU.

    import tk

    capture = tk.open_capture("CAPTURE")
    for estimate in tk.track(capture):  # frame by frame
        print(estimate.frame, estimate.joints)
    result = tk.track(capture, "result.h5")  # or into a file, with a second pass

Importing this changes nothing in the process; the heavy imports wait until a name is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tk.api import open_capture, track
    from tk.io.captures.source import Source
    from tk.io.results.data import Result
    from tk.io.results.reader import read_result
    from tk.io.settings_file import read as read_settings
    from tk.model.body.cone_body import ConeBody as Body
    from tk.model.hull.hull import VisualHull
    from tk.model.setup import Setup
    from tk.run.task import Task
    from tk.settings import Settings
    from tk.trackers.protocol import Estimate

__version__ = "0.1.0"

__all__ = [
    "Body",
    "Estimate",
    "Result",
    "Settings",
    "Setup",
    "Source",
    "Task",
    "VisualHull",
    "__version__",
    "open_capture",
    "read_result",
    "read_settings",
    "track",
]

_HOMES = {
    "Body": ("tk.model.body.cone_body", "ConeBody"),
    "Settings": ("tk.settings", "Settings"),
    "Setup": ("tk.model.setup", "Setup"),
    "Source": ("tk.io.captures.source", "Source"),
    "Task": ("tk.run.task", "Task"),
    "Estimate": ("tk.trackers.protocol", "Estimate"),
    "Result": ("tk.io.results.data", "Result"),
    "VisualHull": ("tk.model.hull.hull", "VisualHull"),
    "open_capture": ("tk.api", "open_capture"),
    "read_result": ("tk.io.results.reader", "read_result"),
    "read_settings": ("tk.io.settings_file", "read"),
    "track": ("tk.api", "track"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tk' has no attribute '{name}'")
    from importlib import import_module

    module, attribute = _HOMES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
