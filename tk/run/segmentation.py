"""Where a capture's masks come from: its own, its empty scene, or a segmenter; else it is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.capture import Capture
from tk.io.captures.frames import FrameSet
from tk.model.masks.background import median_plate
from tk.model.masks.foreground import CollinearityForeground, Foreground
from tk.model.masks.mog2 import Mog2Foreground
from tk.segmenters import INSTALL, load, names
from tk.settings import ForegroundSettings
from tk.threads import one_thread

Segmenter = Callable[[FrameSet], NDArray[np.uint8]]
#: masks, and where they are 0 for what may be the person all the same; None where nobody says
Labeller = Callable[[FrameSet], tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]

# what :func:`mask_source` says; "none": no masks are given, they are made from the empty scene
_GIVEN, _SCENE, _MEDIAN, _SEGMENTER = "given", "none", "median", "segmenter "

# frames from which a background is made where there is no recording of the empty scene
PLATE_FRAMES = 25

# The median is the empty scene where the person covers a pixel in less than half of the frames. In these shares of the
# frames, pixels are covered for long; as many as this share of the person's picture are too many (measured: 0.35 to
# 0.51 on a walk, where the median is as good as a clip, 0.76 to 1.2 on a dance and a treadmill, where it is not).
_LONG, _MANY = 0.4, 0.6
# A smaller visual hull is no person; cameras from four sides make it twice as large as the person is.
_LEAST_LITRES = 40.0

_WAYS_OUT = (
    f"give masks (--masks DIR), a clip of the empty scene (background/<camera>.mp4), or install a segmenter ({INSTALL})"
)
#: why `tk masks` cannot begin
NO_SEGMENTER = f"no segmenter is installed; {INSTALL} brings one"


class MaskSettings(Protocol):
    """What of a :class:`tk.settings.Settings` tells how masks are made; that itself would import every tracker."""

    @property
    def segmentation(self) -> str: ...
    @property
    def foreground(self) -> ForegroundSettings: ...


def mask_source(capture: Capture) -> str:
    """Where masks come from: "given", "none" (the empty scene), "median", or "segmenter NAME".

    Raises:
        CaptureError: there is nothing to make them from.
    """
    if capture.has_masks:
        return _GIVEN
    if capture.masks == "median":
        return _MEDIAN
    if (capture.path / "background").is_dir():
        return _SCENE
    installed = names()
    if not installed:
        raise CaptureError(f"{capture.path}: nothing tells the person from the scene; {_WAYS_OUT}")
    return _SEGMENTER + installed[0]


def make_segmenter(capture: Capture, config: MaskSettings, note: Callable[[str], None]) -> Segmenter:
    """Masks of each frame, from where :func:`mask_source` says."""
    label = make_labeller(capture, config, note)
    return lambda frame: label(frame)[0]


def make_labeller(capture: Capture, config: MaskSettings, note: Callable[[str], None]) -> Labeller:
    """The same, and what is uncertain in them (:attr:`tk.trackers.protocol.Observation.uncertain`).

    Raises:
        CaptureError: there is nothing to make masks from, or the median is not the empty scene.
        ConfigError: the segmenter cannot be loaded.
    """
    if mask_source(capture) in (_GIVEN, _SCENE):
        return _labeller(capture, config, note)  # no product of matrices in it; SciPy takes long to import
    with one_thread():
        return one_thread()(_labeller(capture, config, note))


def _labeller(capture: Capture, config: MaskSettings, note: Callable[[str], None]) -> Labeller:
    source = mask_source(capture)
    if source == _GIVEN:
        return _given_masks
    if source.startswith(_SEGMENTER):
        name = source.removeprefix(_SEGMENTER)
        note(f"{capture.path}: no masks and no background/; the segmenter {name} makes the masks")
        from tk.segmenters.subject_masks import SubjectMasks  # SciPy, which takes a second to import

        made = SubjectMasks(load(name), name, capture.rig, capture.volume)
        return lambda frame: made.label(frame.images)
    foreground = _learn_median(capture, config, note) if source == _MEDIAN else _learn_scene(capture, config)
    return lambda frame: foreground.label(frame.images)


def _learn_scene(capture: Capture, config: MaskSettings) -> Foreground:
    clips = capture.background()
    assert clips is not None
    return _learn(capture, config, clips)


def _learn(capture: Capture, config: MaskSettings, clips: tuple[NDArray[np.uint8], ...]) -> Foreground:
    sizes = [(camera.width, camera.height) for camera in capture.rig]
    learner = CollinearityForeground if config.segmentation == "collinearity" else Mog2Foreground
    return learner.learn(clips, capture.rig.frame_shape, sizes, config.foreground)


def _learn_median(capture: Capture, config: MaskSettings, note: Callable[[str], None]) -> Foreground:
    """The median over the recording for the empty scene, and a look whether it is.

    Raises:
        CaptureError: what differs from it is no person.
    """
    step = -(-capture.frame_count // PLATE_FRAMES)
    with capture.frames() as frames:
        samples = [frame.images.copy() for frame in frames if frame.index % step == 0]
    foreground = _learn(capture, config, median_plate(samples, [(c.width, c.height) for c in capture.rig]))
    masks = np.array([foreground.segment(images) for images in samples]) > 0  # (K, C, H, W)
    from tk.model.masks.subject import CoarseHull  # SciPy

    hull = CoarseHull(capture.rig, capture.volume)
    litres = float(np.median([hull.litres(hull.subject(each.view(np.uint8))) for each in masks]))
    if litres < _LEAST_LITRES:
        raise CaptureError(
            f"{capture.path}: --masks median cannot work: what differs from the median of {len(samples)} frames "
            f"makes a hull of {litres:.0f} litres, so the person hardly moves and is in the median; {_WAYS_OUT}"
        )
    long = np.count_nonzero(masks.mean(axis=0) > _LONG, axis=(1, 2))
    area = np.maximum(masks.sum(axis=(2, 3)).mean(axis=0), 1)
    poor = [name for name, share in zip(capture.rig.names, long / area, strict=True) if share > _MANY]
    note(f"{capture.path}: the median of {len(samples)} frames is taken for the empty scene")
    if poor:
        note(
            f"{capture.path}: in {', '.join(poor)} the person is before the same pixels in over {_LONG:.0%} of the "
            f"frames, so the median shows parts of him or her, and the poses may be wrong; better: {_WAYS_OUT}"
        )
    return foreground


def _given_masks(frame: FrameSet) -> tuple[NDArray[np.uint8], None]:
    assert frame.masks is not None
    return frame.masks, None
