"""Masks of a source: its own, made against its empty scene, or by a segmenter; without any of these it is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError
from tk.io.captures.frames import FrameSet
from tk.io.captures.source import Source
from tk.model.masks.background import median_plate
from tk.model.masks.foreground import CollinearityForeground, Foreground
from tk.model.masks.image_shift import exchanged_scenes
from tk.run.learned_masks import MASK_SOURCES, LearnedMasks
from tk.run.task import Task
from tk.segmenters import INSTALL, PoseSegmenter, at_hand, load, names
from tk.threads import one_thread

if TYPE_CHECKING:
    from tk.segmenters.people_masks import PeopleMasks


class Labels(NamedTuple):
    """The masks of a frame set.

    Attributes:
        masks, uncertain, sources, landmarks, people: as a :class:`~tk.trackers.protocol.Frame` has them.
    """

    masks: NDArray[np.uint8]
    uncertain: NDArray[np.bool_] | None = None
    sources: NDArray[np.uint8] | None = None
    landmarks: NDArray[np.float64] | None = None
    people: NDArray[np.uint8] | None = None


Labeller = Callable[[FrameSet], Labels]
LandmarkAsker = Callable[[NDArray[np.uint8], NDArray[np.float64]], NDArray[np.float64] | None]

# what :func:`mask_source` returns; "none": no masks are given, they are made from the empty scene
_GIVEN, _SCENE, _MEDIAN, _SEGMENTER = "given", "none", "median", "segmenter "

# Frames of the median background.
PLATE_FRAMES = 50

# The median is the empty scene where the person covers a pixel in less than half of the frames. A pixel that is covered
# in more than _LONG of the frames is in danger; a note says so if these pixels exceed _MANY of the person's area.
_LONG, _MANY = 0.4, 0.6
# litres, least volume of a person's visual hull; with cameras on four sides the hull is twice as large as the person
_LEAST_LITRES = 40.0

_WAYS_OUT = (
    f"give a folder of masks, a clip of the empty scene (background/<camera>.mp4), or install a segmenter ({INSTALL})"
)
#: why `tk masks` cannot begin
NO_SEGMENTER = f"no segmenter is installed; {INSTALL} brings one"


def mask_source(source: Source) -> str:
    """Return where masks come from: "given", "none" (the empty scene), "median", or "segmenter NAME".

    Raises:
        CaptureError: there is nothing to make them from.
    """
    if source.has_masks:
        return _GIVEN
    if source.segmenter is not None:
        return _SEGMENTER + type(source.segmenter).__name__
    if source.masks_from:
        return source.masks_from
    installed = names()
    if not installed:
        raise CaptureError(
            f"{source.where}: no masks, no empty scene and no segmenter; {_WAYS_OUT}",
            hint="--masks DIR names a folder of masks",
        )
    return _SEGMENTER + installed[0]


def sources_of_masks(source: Source) -> tuple[str, ...]:
    """Return the meanings of :attr:`Labels.sources`; none if no segmenter makes the masks."""
    return MASK_SOURCES if mask_source(source).startswith(_SEGMENTER) else ()


def make_labeller(task: Task, note: Callable[[str], None]) -> Labeller:
    """Return a function from a frame set to its masks, their uncertain pixels, and their sources, from where
    :func:`mask_source` says; ``note`` receives lines for the user.

    Raises:
        CaptureError: there is nothing to make masks from, or the median is not the empty scene.
        ConfigError: the segmenter cannot be loaded.
    """
    asks = task.settings.landmarks == "always"
    if mask_source(task.source) in (_GIVEN, _SCENE) and not asks:
        return _labeller(task, note)  # no matrix products in it; SciPy takes long to import
    with one_thread():
        labeller = _labeller(task, note)
        if task.settings.landmarks == "never":
            return one_thread()(lambda frame: labeller(frame)._replace(landmarks=None))
        return one_thread()(_with_landmarks(task, labeller) if asks else labeller)


def sees_landmarks(task: Task) -> bool:
    """Return whether a network's landmarks are used in some frames."""
    if task.settings.landmarks == "auto":
        return bool(sources_of_masks(task.source)) or _asked_for_landmarks(task) is not None
    return task.settings.landmarks == "always"


def _asked_for_landmarks(task: Task) -> str | None:
    """Return the segmenter that trackers ask for landmarks: the one that makes the masks, or else one that is installed
    with its weights. None: they ask none, because there is none, or every frame has its landmarks."""
    if task.settings.landmarks != "auto":
        return None
    if (given := task.source.segmenter) is not None:
        return type(given).__name__ if isinstance(given, PoseSegmenter) else None
    origin = mask_source(task.source)
    return origin.removeprefix(_SEGMENTER) if origin.startswith(_SEGMENTER) else at_hand()


def landmark_asker(task: Task) -> LandmarkAsker | None:
    """Return what trackers ask for a person's landmarks where silhouettes leave a pose open: a function from images
    (C, h, w, 3), which may be reduced, and the places (L, 3) where the landmarks are expected, world frame, metres.

    It returns landmarks (C, L, 4), None if nobody can be there. The network is loaded when it is first asked.
    """
    if (name := _asked_for_landmarks(task)) is None:
        return None
    size = task.setup.rig.frame_shape[::-1]
    network = cache(lambda: _network(task, name))

    def ask(images: NDArray[np.uint8], points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        whole = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_LINEAR) for image in images])
        return network().landmarks(whole, points)

    return ask


def people_in_scene(task: Task, images: NDArray[np.uint8]) -> NDArray[np.float64] | None:
    """Return the landmarks (N, C, L, 4) of the people in images (C, H, W, 3) of the empty scene; None if there is no
    network that trackers ask for landmarks."""
    name = _asked_for_landmarks(task)
    return None if name is None else _network(task, name).label(images).landmarks


def _network(task: Task, name: str) -> PeopleMasks:
    """Return the people in all images by a segmenter of this name.

    Raises:
        ConfigError: it cannot be loaded.
    """
    from tk.segmenters.people_masks import PeopleMasks  # SciPy, which takes a second to import

    return PeopleMasks(task.source.segmenter or load(name), name, task.setup.rig, task.setup.volume)


def _with_landmarks(task: Task, labeller: Labeller) -> Labeller:
    """Return a labeller that asks the segmenter for the landmarks of every frame.

    Raises:
        ConfigError: no segmenter is installed, or it cannot be loaded.
    """
    installed = names()
    if task.source.segmenter is None and not installed:
        raise ConfigError(f"landmarks = always: {NO_SEGMENTER}")
    name = installed[0] if task.source.segmenter is None else type(task.source.segmenter).__name__
    people = _network(task, name)

    def label(frame: FrameSet) -> Labels:
        labels = labeller(frame)
        if labels.landmarks is None and frame.images.size:
            seen = people.label(frame.images)
            labels = labels._replace(landmarks=seen.landmarks, people=seen.people)
        return labels

    return label


def prepare_kernels() -> None:
    """Compile the kernels of the masks; otherwise each is compiled when it is first called."""
    scene = np.full((1, 64, 64, 3), 100, np.uint8)
    person = scene.copy()
    person[:, 10:50, 24:40] = 200  # where nothing differs no kernel is called
    CollinearityForeground.learn([scene], (64, 64), [(64, 64)]).label(person)


def _labeller(task: Task, note: Callable[[str], None]) -> Labeller:
    source = task.source
    origin = mask_source(source)
    if origin == _GIVEN:
        return _given_masks
    if origin.startswith(_SEGMENTER):
        name = origin.removeprefix(_SEGMENTER)
        if source.segmenter is None:
            note(f"{source.where}: no masks and no background/; the segmenter {name} makes the masks")
        learned = LearnedMasks(task, _network(task, name))
        if reason := learned.why_throughout():
            note(f"{source.where}: the segmenter makes the masks of every frame, which takes long: {reason}")
        return lambda frame: Labels(*learned.label(frame))
    if origin == _MEDIAN:
        foreground = _learn_median(task, note)
    else:
        clips = source.background()
        assert clips is not None
        return _against_scene(task, clips)
    return lambda frame: Labels(*foreground.label(frame.images, frame.halved))


def _against_scene(task: Task, clips: Sequence[NDArray[np.uint8]]) -> Labeller:
    """Return a segmentation against clips of the empty scene, which refuses exchanged videos at the first frame."""
    foreground, where = _learn(task, clips), task.source.where
    names, scenes = task.setup.rig.names, [clip[0].copy() for clip in clips]

    def label(frame: FrameSet) -> Labels:
        labels = Labels(*foreground.label(frame.images, frame.halved))
        if scenes:
            exchanged = exchanged_scenes(scenes, frame.images, labels.masks)
            scenes.clear()
            if exchanged:
                shown = (f"the video of {names[a]} shows the empty scene of {names[b]}" for a, b in exchanged.items())
                raise CaptureError(f"{where}: {', '.join(shown)}: exchange the videos, or the files in background/")
        return labels

    return label


def _learn(task: Task, clips: Sequence[NDArray[np.uint8]]) -> Foreground:
    rig = task.setup.rig
    return CollinearityForeground.learn(clips, rig.frame_shape, rig.sizes, task.settings.foreground)


def _learn_median(task: Task, note: Callable[[str], None]) -> Foreground:
    """Return a segmentation against the median of the recording, after a check that the median is the empty scene.

    Raises:
        CaptureError: no person differs from the median, or the length of the source is unknown.
    """
    setup, source = task.setup, task.source
    if source.frame_count is None:
        raise CaptureError(f"{source.where}: the median needs a recording; {_WAYS_OUT}")
    step = -(-source.frame_count // PLATE_FRAMES)
    with source.frames() as frames:
        samples = [frame.images.copy() for frame in frames if frame.index % step == 0]
    foreground = _learn(task, median_plate(samples, setup.rig.sizes))
    masks = np.array([foreground.label(images)[0] for images in samples]) > 0  # (K, C, H, W)
    from tk.model.hull.coarse import CoarseHull  # SciPy

    hull = CoarseHull(setup.rig, setup.volume)
    litres = float(
        np.median([hull.litres(hull.subject(each.view(np.uint8), np.ones(len(each), np.bool_))) for each in masks])
    )
    if litres < _LEAST_LITRES:
        raise CaptureError(
            f"{source.where}: the median cannot work: what differs from the median of {len(samples)} frames "
            f"makes a hull of {litres:.0f} litres, so the person hardly moves and is in the median; {_WAYS_OUT}"
        )
    long = np.count_nonzero(masks.mean(axis=0) > _LONG, axis=(1, 2))
    area = np.maximum(masks.sum(axis=(2, 3)).mean(axis=0), 1)
    poor = [name for name, share in zip(setup.rig.names, long / area, strict=True) if share > _MANY]
    note(f"{source.where}: the median of {len(samples)} frames is taken for the empty scene")
    if poor:
        note(
            f"{source.where}: in {', '.join(poor)} the person covers the same pixels in over {_LONG:.0%} of the "
            f"frames, so the median shows parts of the person, and the poses may be wrong; better: {_WAYS_OUT}"
        )
    return foreground


def _given_masks(frame: FrameSet) -> Labels:
    assert frame.masks is not None
    return Labels(frame.masks)
