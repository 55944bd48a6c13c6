"""What a run is asked to do: the scene, its images, and the options of the user.

Nothing heavy is imported here: every process of a run and of a batch needs this module.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from tk.errors import ConfigError
from tk.settings import Settings

if TYPE_CHECKING:
    from tk.io.captures.capture import Capture
    from tk.io.captures.source import Source
    from tk.model.setup import Setup

Choice = str | tuple[int, ...]
"""Who is tracked: "auto" (one person), "all", or numbers."""


def parse_choice(text: str) -> Choice:
    """Return the choice that a user gives as "auto", "all" or numbers, such as "0,2".

    Raises:
        ConfigError: it is none of these.
    """
    if text in ("auto", "all"):
        return text
    numbers = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in numbers) or len(set(numbers)) < len(numbers):
        raise ConfigError(f"people {text!r}: give auto, all, or different numbers from 0 on, such as 0,2")
    return tuple(map(int, numbers))


def describe(choice: Choice) -> str:
    """Return a choice as the user gives it."""
    return choice if isinstance(choice, str) else ",".join(map(str, choice))


@dataclass(frozen=True)
class TrackOptions:
    """How a run tracks.

    Attributes:
        settings: all settings.
        method: name of the tracker.
        frames: range of frames to write, end exclusive (None: to the end of the source).
        people: "auto": one person, the first by :func:`tk.people.find.order_people`; "all": everybody in the working
            volume, also who enters later; or the numbers of people in that order, then in that of
            entering.
        causal: stop after the first pass, in which no frame depends on later ones.
        store_hull: store the hull's surface in the result, too.
    """

    settings: Settings = field(default_factory=Settings)
    method: str = "region"
    frames: tuple[int, int | None] = (0, None)
    people: Choice = "auto"
    causal: bool = False
    store_hull: bool = False


@dataclass(frozen=True)
class RecordingOptions(TrackOptions):
    """How a recording is opened and tracked: the options of `tk track` and `tk batch`.

    Attributes:
        cameras, masks: for :func:`tk.io.captures.capture.open_capture`. An open capture knows its own.
        init_pose: a file with a rough initial pose, see :mod:`tk.io.captures.init_pose`, or a folder of 2D keypoints,
            see :mod:`tk.io.captures.keypoints`.
        body: a result or a TOML file that holds a body.
    """

    cameras: tuple[str, ...] | None = None
    masks: str = "auto"
    init_pose: Path | None = None
    body: Path | None = None


@dataclass(frozen=True)
class Task:
    """What a run works on.

    Attributes:
        setup: the scene.
        source: the images.
        options: how they are tracked.
        notes: notes about the input, for the user and the result.
    """

    setup: Setup
    source: Source
    options: TrackOptions = field(default_factory=TrackOptions)
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, capture: Capture, settings: Settings) -> Task:
        """Return the task for a recording as its folder describes it, all options being the defaults."""
        return cls(capture.setup(), capture, TrackOptions(settings))

    @property
    def settings(self) -> Settings:
        """All settings."""
        return self.options.settings
