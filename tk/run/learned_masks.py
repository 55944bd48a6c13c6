"""Masks of a recording without an empty scene, which is learned from the masks that a segmenter makes of a few frames.

The recording is divided into spans of about ten seconds. In each span the segmenter is asked for frames spread evenly
over it (:class:`~tk.segmenters.people_masks.PeopleMasks`), and the empty scene is learned from them
(:class:`~tk.model.masks.learned_scene.LearnedScene`). All other masks are a segmentation against that scene. Where the
scene is unknown, the segmenter's masks before and after the frame decide; where they differ, pixels are uncertain. The
asked frames are also a check: around one in which the segmentation disagrees, the segmenter makes all masks between the
asked frames before and after it.

The first pose needs the masks of the opening. Their scene is learned from the first eight asked frames only, so that
they need not wait for the others of the span.

The masks of a frame depend on the recording alone, so `--resume` and `--frames` see the same masks. In a source of
unknown length the scene is learned from the frames asked for so far; until they are enough, the segmenter makes all
masks.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.capture import Capture
from tk.io.captures.frames import FrameSet
from tk.model.masks.foreground import CollinearityForeground, Prior
from tk.model.masks.learned_scene import LearnedScene
from tk.run.task import Task

if TYPE_CHECKING:  # SciPy, which takes long to import
    from tk.segmenters.people_masks import PeopleMasks, Segmented

Masks = NDArray[np.uint8]
Bool = NDArray[np.bool_]
#: a frame's number, and what the segmenter sees in it
_Asked: TypeAlias = "tuple[int, Segmented]"

#: where the masks of a camera come from, as a result stores it
LEARNED, LEARNED_AND_SEGMENTER, SEGMENTER = range(3)
MASK_SOURCES = ("learned scene", "learned scene and segmenter", "segmenter")

# Seconds of a span, between asked frames, and least number of asked frames of a span; the opening waits for so many.
_SPAN_S, _STEP_S, _LEAST = 10.0, 0.5, 8
# Asked frames that a source of unknown length is learned from, and how many come between two times of learning.
_PAST, _EVERY = 16, 4
# At most this share of the frames is asked for; a span with fewer than _LEAST such frames is segmented throughout.
_SHARE = 0.16
# Most bytes of a span's samples. With fewer samples, more of the scene is unknown.
_SAMPLE_BYTES = 512_000_000
# Masks disagree if more than this share of the pixels in either is in only one of them.
_DISAGREE = 0.65


@dataclass(frozen=True, eq=False)
class _Sample:
    """What the segmenter sees in a frame.

    Attributes:
        check: compares it with the segmentation against the learned scene; called once, when the first frame needs it:
            the first pose need not wait for the other samples.
    """

    index: int
    seen: Segmented
    check: Callable[[], Bool]

    @cached_property
    def agrees(self) -> Bool:
        """(C,) whether the learned scene agrees."""
        return self.check()


@dataclass(frozen=True)
class _Span:
    """A learned span of the recording, frames ``begin`` to ``stop``, exclusive. None: the segmenter makes all masks."""

    begin: int
    stop: int
    foreground: CollinearityForeground | None
    samples: tuple[_Sample, ...]

    def around(self, index: int) -> tuple[_Sample, _Sample]:
        """Return the samples before and after a frame; twice the same at a sample and beyond the outermost."""
        after = bisect_left(self.samples, index, key=lambda sample: sample.index)
        if after == len(self.samples):
            return self.samples[-1], self.samples[-1]
        exact = after == 0 or self.samples[after].index == index
        return self.samples[after if exact else after - 1], self.samples[after]


@dataclass(frozen=True)
class _Part:
    """Frames ``begin`` to ``stop``, exclusive, whose scene is learned from these samples; without any, the segmenter
    makes all masks."""

    begin: int
    stop: int
    samples: tuple[int, ...]


class LearnedMasks:
    """Segments the people in the frames of a recording, best in order."""

    def __init__(self, task: Task, people: PeopleMasks) -> None:
        setup, source = task.setup, task.source
        self._source, self._settings, self._people = source, task.settings, people
        self._sizes = setup.rig.sizes
        self._fps, self._cameras = setup.fps, len(setup.rig)
        self._parts = self._divided(task.settings.silhouette.init_frames)
        self._span = _Span(0, 0, None, ())
        self._taken: dict[int, tuple[Masks, Segmented]] = {}  # samples of the span: images, and what is seen in them
        self._coming: Sequence[int] = ()  # the samples that are read next
        self._reading: Iterator[FrameSet] = iter(())
        self._open = ExitStack()
        self._past: deque[tuple[Masks, _Asked]] = deque(maxlen=_PAST)
        self._asked = 0

    def why_throughout(self) -> str | None:
        """Return why the segmenter makes all masks of a recording; None if it makes some of them."""
        if not self._parts or self._parts[0].samples:
            return None
        if self._most_samples < _LEAST:
            return "the images are too large to keep samples of the scene"
        return f"fewer than {math.ceil(_LEAST / _SHARE)} frames are too few to learn the empty scene from"

    @property
    def _most_samples(self) -> int:
        width, height = self._sizes.max(axis=0)
        return _SAMPLE_BYTES // (5 * self._cameras * int(height) * int(width))

    def label(self, frame: FrameSet) -> tuple[Masks, Bool, NDArray[np.uint8], NDArray[np.float64] | None, Masks | None]:
        """Return masks (C, H, W), uncertain pixels (C, H, W), where each camera's mask comes from (C,), and the
        landmarks (N, C, L, 4) and the people's masks (C, H, W) if the segmenter was asked for this frame."""
        span = self._follow(frame) if self._source.frame_count is None else self._span_of(frame.index)
        before, after = span.around(frame.index) if span.samples else (None, None)
        asked = before is not None and before is after and before.index == frame.index
        if span.foreground is None or before is None or after is None:
            whole = before.seen if before and asked else self._seen(frame, before)
            kind = np.full(self._cameras, SEGMENTER, np.uint8)
            return whole.masks, whole.uncertain, kind, whole.landmarks, whole.people
        masks, uncertain = span.foreground.label(frame.images, frame.halved, _between(before, after))
        kind = np.full(self._cameras, LEARNED_AND_SEGMENTER if asked else LEARNED, np.uint8)
        failed, seen = ~(before.agrees & after.agrees), before.seen if asked else None
        if failed.any():
            seen = seen or self._seen(frame, before)
            masks[failed], uncertain[failed] = seen.masks[failed], seen.uncertain[failed]
            kind[failed] = SEGMENTER
        masks = self._people.without_specks(masks)
        return masks, uncertain, kind, *((None, None) if seen is None else (seen.landmarks, seen.people))

    def _seen(self, frame: FrameSet, near: _Sample | None) -> Segmented:
        """Ask for a frame that is no sample; people are expected where the sample before it shows them."""
        return self._people.label(frame.images, (near and near.seen.places) or (), frame.index)

    def _divided(self, opening: int) -> list[_Part]:
        """Return the parts of the recording: its spans, of which the first begins with the frames of the opening."""
        edges = _edges(self._source.first_frame, self._source.frame_count, self._fps)
        parts = [_Part(begin, stop, self._chosen(begin, stop)) for begin, stop in pairwise(edges)]
        first = parts[0] if parts else _Part(0, 0, ())
        if len(first.samples) > _LEAST and (end := first.begin + opening) < first.stop:
            parts[:1] = [_Part(first.begin, end, first.samples[:_LEAST]), _Part(end, first.stop, first.samples)]
        return parts

    def _span_of(self, index: int) -> _Span:
        within = min(max(index, self._parts[0].begin), self._parts[-1].stop - 1)
        if not self._span.begin <= within < self._span.stop:
            k = bisect_right(self._parts, within, key=lambda part: part.begin)
            self._span = self._learn(self._parts[k - 1], *self._parts[k : k + 1])
        return self._span

    def _learn(self, part: _Part, following: _Part | None = None) -> _Span:
        """Ask for the masks of a part's samples and learn its scene. ``following``: the part after it, if any."""
        if not part.samples:
            return _Span(part.begin, part.stop, None, ())
        self._take(part.samples)
        images, seen = zip(*self._taken.values(), strict=True)
        samples = list(zip(part.samples, seen, strict=True))
        foreground = self._foreground(images, samples)
        kept = dict(zip(part.samples, images, strict=True))
        if following is None or part.samples[0] not in following.samples:
            self._taken = {}  # images are large, and a check is the last to need them
        return _Span(part.begin, part.stop, foreground, tuple(_checked(foreground, kept, each) for each in samples))

    def _take(self, samples: tuple[int, ...]) -> None:
        """Ask for the masks of samples; of those that the part before has begun with, for the others."""
        self._taken = {k: self._taken[k] for k in samples if k in self._taken}
        missing = samples[len(self._taken) :]
        if missing and (not self._coming or self._coming[0] != missing[0]):
            self._open.close()
            following = {k for part in self._parts for k in part.samples if k >= missing[0]}
            self._coming = sorted(following)
            self._reading = self._open.enter_context(self._frames_of(self._coming))
        for index in missing:
            frame = next(frame for frame in self._reading if frame.index == index)
            seen = self._next_sample(frame.images, [seen for _, seen in self._taken.values()], len(self._taken))
            self._taken[index] = frame.images.copy(), seen
        self._coming = self._coming[len(missing) :]

    def _frames_of(self, samples: Sequence[int]) -> AbstractContextManager[Iterator[FrameSet]]:
        """Return the frames of samples; with all frames between them if the source cannot leave them out."""
        if not isinstance(self._source, Capture):
            return self._source.frames(samples[0], self._source.frame_count)
        return self._source.some_frames(samples)

    def _next_sample(self, images: Masks, before: Sequence[Segmented], turn: int) -> Segmented:
        """Ask for a sample after others: the people of the last one are expected to have moved on. ``turn``: number of
        the sample."""
        last, earlier = ([seen.places or () for seen in reversed(before)] + [(), ()])[:2]
        return self._people.label(images, [place.ahead(earlier) for place in last], turn)

    def _follow(self, frame: FrameSet) -> _Span:
        """Ask for the masks of a frame of a source of unknown length if the last time is long ago; return what is
        learned so far, with the last sample."""
        if frame.index < self._span.stop:
            return self._span
        before = [seen for _, (_, seen) in self._past]
        sample = (frame.index, self._next_sample(frame.images, before, self._asked))
        self._past.append((frame.images.copy(), sample))
        self._asked += 1
        foreground = self._span.foreground
        if self._asked >= _LEAST and self._asked % _EVERY == 0:
            foreground = self._foreground([image for image, _ in self._past], [each for _, each in self._past])
        checked = _checked(foreground, {frame.index: self._past[-1][0]}, sample)
        self._span = _Span(frame.index, frame.index + max(round(_STEP_S * self._fps), 1), foreground, (checked,))
        return self._span

    def _foreground(self, images: Sequence[Masks], samples: Sequence[_Asked]) -> CollinearityForeground:
        scene = LearnedScene.learn(images, [s.masks for _, s in samples], [s.uncertain for _, s in samples])
        return CollinearityForeground.of_learned(scene, self._sizes, self._settings.foreground)

    def _chosen(self, begin: int, stop: int) -> tuple[int, ...]:
        """Return the frames of a span that the segmenter is asked for; none if they would be too many or too few."""
        frames = stop - begin
        most = min(_SHARE * frames, self._most_samples)
        count = int(min(max(frames / self._fps / _STEP_S, _LEAST), most))
        if count < _LEAST:
            return ()
        # both ends, because unknown pixels between two samples are safer than beyond the outermost
        return tuple(begin + (frames - 1) * k // (count - 1) for k in range(count))


def _checked(foreground: CollinearityForeground | None, images: dict[int, Masks], asked: _Asked) -> _Sample:
    """Return a sample, whose check takes its images out of the ``images`` by number."""
    index, seen = asked

    def check() -> Bool:
        shown = images.pop(index)
        if foreground is None:
            return np.zeros(len(seen.masks), np.bool_)
        found = foreground.label(shown, prior=Prior.of(seen.masks, seen.uncertain))[0]
        one, either = (np.count_nonzero(pixels, axis=(1, 2)) for pixels in (found ^ seen.masks, found | seen.masks))
        return np.asarray(one <= _DISAGREE * either)

    return _Sample(index, seen, check)


def _edges(first: int, count: int | None, fps: float) -> list[int]:
    """Return the first frames of all spans, and the end of the last one; of a source of unknown length none."""
    if count is None:
        return []
    spans = max(round((count - first) / (_SPAN_S * fps)), 1)
    return [first + (count - first) * k // spans for k in range(spans + 1)]


@lru_cache(1)  # the frames between two samples ask one after the other
def _between(before: _Sample, after: _Sample) -> Prior:
    """Return what two samples say of the pixels between them."""
    one, other = before.seen, after.seen
    if before is after:
        return Prior.of(one.masks, one.uncertain)
    person = one.masks & other.masks
    return Prior.of(person, (one.masks > person) | (other.masks > person) | one.uncertain | other.uncertain)
