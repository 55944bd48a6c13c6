"""Which segmentation a capture gets: its own masks, or one learned from its background."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tk.config import Config
from tk.io.capture import Capture
from tk.io.frames import FrameSet
from tk.model.foreground import CollinearityForeground
from tk.model.mog2 import Mog2Foreground
from tk.model.scene import median_plate

Segmenter = Callable[[FrameSet], NDArray[np.uint8]]
#: masks, and where they are 0 for what may be the person all the same; None where nobody says
Labeller = Callable[[FrameSet], tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]

# frames from which a background is made where there is no recording of the empty scene
PLATE_FRAMES = 25


def make_segmenter(capture: Capture, config: Config, note: Callable[[str], None]) -> Segmenter:
    """Masks of each frame: the capture's own, or a segmentation learned from its background."""
    label = make_labeller(capture, config, note)
    return lambda frame: label(frame)[0]


def make_labeller(capture: Capture, config: Config, note: Callable[[str], None]) -> Labeller:
    """The same, and what is doubtful in them (:attr:`tk.trackers.base.Observation.doubtful`)."""
    if capture.has_masks:
        return _given_masks
    sizes = [(camera.width, camera.height) for camera in capture.rig]
    clips = capture.background()
    if clips is None:
        note(
            f"{capture.path}: no masks and no background/; the median of up to {PLATE_FRAMES} frames is the empty scene"
        )
        step = -(-capture.frame_count // PLATE_FRAMES)
        with capture.frames() as frames:
            samples = [frame.images.copy() for frame in frames if frame.index % step == 0]
        clips = median_plate(samples, sizes)
    learner = CollinearityForeground if config.segmentation == "collinearity" else Mog2Foreground
    foreground = learner.learn(clips, capture.rig.frame_shape, sizes, config.foreground)
    return lambda frame: foreground.label(frame.images)


def _given_masks(frame: FrameSet) -> tuple[NDArray[np.uint8], None]:
    assert frame.masks is not None
    return frame.masks, None
