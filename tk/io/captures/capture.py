"""A capture: the folder of a recording. Opening it checks what can be checked without decoding all images."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.calibration import Calibration, read_calibration
from tk.io.captures.capture_toml import CaptureSettings, GivenSubject, Span, read_settings
from tk.io.captures.clip import Clip
from tk.io.captures.clip_folder import clips_of, open_clips, open_masks, read_some
from tk.io.captures.clock import Clock, OnClock, put_on_clock
from tk.io.captures.frames import FrameReader, FrameSet
from tk.io.captures.referred import referred_clips, referred_stamps
from tk.io.captures.scene import up_of, volume_of, warn_of_units
from tk.io.captures.session import inherited, is_session, trials
from tk.io.captures.timing import Stamps, check_clock, read_stamps
from tk.io.captures.video import VideoClip, damaged_images, notes_on, odd_turn
from tk.io.paths import text_of
from tk.model.cameras.camera import Rig
from tk.model.cameras.up import shown, up_vector
from tk.model.cameras.volume import Volume
from tk.model.masks.image_health import described
from tk.model.setup import Setup, Subject

if TYPE_CHECKING:
    from tk.segmenters import Segmenter

__all__ = ["Capture", "FrameReader", "FrameSet", "open_capture"]

#: frame rate, 1/s, if neither `capture.toml` nor the videos give one; a note says so
DEFAULT_FPS = 30.0

# Most images of the empty scene for each camera, the first of a clip; most recorded pixels and most bytes of all of
# them, but at least so many images. Decoding more delays the first pose.
_BACKGROUND_FRAMES, _LEAST_BACKGROUND = 32, 8
_BACKGROUND_PIXELS, _BACKGROUND_BYTES = 50_000_000, 400_000_000

#: most images of a video that are checked for damage after a camera has disagreed: about a millisecond each
_CHECKED_IMAGES = 3000


@dataclass(frozen=True, repr=False)
class Capture:
    """An open capture folder, a :class:`~tk.io.captures.source.Source`. :meth:`frames` reads its images.

    Attributes:
        path: the folder.
        name: from `capture.toml`, else the folder's name.
        fps: frame rate, 1/s, from `capture.toml`, else from the time stamps, else 30.
        up: axis that points up in the world: x, y, z, -x, -y or -z, or a unit vector, "[0.02, -0.9998, 0.01]".
        rig: the cameras, in the calibration file's order.
        volume: the working volume, world frame, metres; inferred from the rig if `capture.toml` has none.
        frame_count: number of frames that all cameras (and masks) have.
        init_frame: the frame in which the subject stands in the initialisation pose.
        init_pose: "da-vinci", or "any" if the subject may begin in any pose.
        init_keypoints: folder of 2D keypoints of the first pose; None if there is none.
        warnings: lines about the capture that the user should read.
        clips: one clip for each camera.
        mask_clips: one clip of masks for each camera; None without given masks.
        masks: argument of :func:`open_capture`.
        clock: times of the frames, if they were chosen by time stamps; None: frame k is image k of each camera.
        empty_clips: one clip of the empty scene for each camera, if a part of the recording shows it; else None.
        calibration: of the cameras that are used.
        time_offset_s: delay of each camera, seconds, from the calibration; :meth:`frames` corrects whole frames of it.
        segmenter: makes the masks if none are given; None: the empty scene, or an installed segmenter.
        subjects: what `capture.toml` says about the people, at least one.
    """

    path: Path
    name: str
    fps: float
    up: str
    rig: Rig
    volume: Volume
    frame_count: int
    init_frame: int
    init_pose: str
    init_keypoints: Path | None
    warnings: tuple[str, ...]
    clips: tuple[Clip, ...]
    mask_clips: tuple[Clip, ...] | None
    masks: str
    clock: Clock | None
    empty_clips: tuple[Clip, ...] | None
    calibration: Calibration
    time_offset_s: tuple[float, ...]
    segmenter: Segmenter | None = None
    subjects: tuple[GivenSubject, ...] = (GivenSubject(),)

    def __repr__(self) -> str:
        """Return folder, cameras, frames and masks, in four lines."""
        by_size: dict[str, list[str]] = {}
        for camera in self.rig:
            by_size.setdefault(f"{camera.width}×{camera.height}", []).append(camera.name)
        cameras = "; ".join(f"{', '.join(names)} ({size})" for size, names in by_size.items())
        made = {"none": "against the empty scene in background", "median": "against the median image", "": "not given"}
        masks = made.get(self.masks_from, f"from {self.masks_from}")
        count = self.frame_count - self.first_frame
        return (
            f"Capture {self.name}: {self.path}\n"
            f"{len(self.rig)} cameras: {cameras}\n"
            f"{count} frames, {self.first_frame} to {self.frame_count - 1}, {count / self.fps:.1f} s at "
            f"{self.fps:g} frames/s\n"
            f"masks: {masks}; up: {shown(self.up)}"
        )

    @property
    def late_frames(self) -> tuple[int, ...]:
        """Delay of each camera in whole frames: frame k of the capture holds image k - late."""
        return tuple(round(late * self.fps) for late in self.time_offset_s)

    @property
    def first_frame(self) -> int:
        """First frame of which every camera has an image."""
        return max(0, *self.late_frames)

    def as_recorded(self) -> Capture:
        """Return the capture without its time offsets: frame k holds image k of every camera."""
        clips = (*self.clips, *(self.mask_clips or ()))
        return replace(self, time_offset_s=(0.0,) * len(self.rig), frame_count=min(clip.frame_count for clip in clips))

    @property
    def resampled(self) -> bool:
        """Whether frames were chosen by time stamps."""
        return self.clock is not None

    @property
    def videos(self) -> tuple[str, ...]:
        """Names and sizes of files outside the folder that hold the images."""
        files = [part.path for clip in self.clips for part in clip.parts]
        outside = [file for file in files if self.path / "videos" != file.parent and file.is_file()]
        return tuple(f"{file.resolve()} {file.stat().st_size}" for file in outside)

    @property
    def subject_height_m(self) -> float | None:
        """Height of the first subject, metres; None if unknown."""
        return self.subjects[0].height_m

    @property
    def truth_file(self) -> Path:
        """The ground truth; only evaluation captures have the file."""
        return self.path / "truth.h5"

    @property
    def has_masks(self) -> bool:
        """Whether masks are given."""
        return self.mask_clips is not None

    @property
    def where(self) -> str:
        """The folder, as messages name it."""
        return str(self.path)

    @property
    def masks_from(self) -> str:
        """Where masks come from, see :attr:`tk.io.captures.source.Source.masks_from`."""
        if self.mask_clips is not None:
            return os.path.relpath(self.mask_clips[0].path.parent, self.path)
        if self.masks == "median":
            return "median"
        return "none" if self.empty_clips or inherited(self.path, "background").is_dir() else ""

    def setup(self) -> Setup:
        """Return what `calibration.toml` and `capture.toml` say about the scene."""
        subjects = []
        for given in self.subjects:
            position = None if given.position is None else np.array(given.position)
            in_init_pose = self.init_pose != "any"
            subjects.append(Subject(given.height_m, self.init_frame, position=position, in_init_pose=in_init_pose))
        return Setup(self.rig, self.volume, self.up, self.fps, tuple(subjects))

    def shifted(self, time_offset_s: Sequence[float]) -> Capture:
        """Return the capture with other time offsets (C,); it ends with the first video."""
        moved = replace(self, time_offset_s=tuple(time_offset_s))
        ends = [clip.frame_count + late for clip, late in zip(self.clips, moved.late_frames, strict=True)]
        return replace(moved, frame_count=min(self.frame_count, *ends))

    def damaged(self, stop: int, cameras: NDArray[np.bool_]) -> list[str]:
        """Return a line on each video of some cameras, (C,) bool, with images before frame ``stop`` that cannot be
        decoded completely, or with another turn than most of the others."""
        lines = []
        for camera in np.flatnonzero(cameras).tolist():
            clip, late = self.clips[camera], self.late_frames[camera]
            frames = np.arange(self.first_frame, min(stop, self.frame_count))[:_CHECKED_IMAGES]
            numbers, first = clip.shown(frames - late), 0
            for part in clip.parts:
                own = numbers - first
                own, first = np.where(own < part.frame_count, own, -1), first + part.frame_count
                if isinstance(part, VideoClip) and (own >= 0).any():
                    bad = damaged_images(part, int(own.max()) + 1, int(own[own >= 0].min()))
                    if len(shown_bad := frames[np.isin(own, bad)]):
                        which = described(int(shown_bad[0]), int(shown_bad[-1]), len(shown_bad))
                        lines.append(f"{part.path}: is damaged in {which}; copy it again, or re-encode the original")
            if turn := odd_turn(clip, self.clips):
                lines.append(f"{clip.path}: {turn}")
        return lines

    @property
    def up_axis(self) -> NDArray[np.float64]:
        """(3,) unit vector that points up, world frame."""
        return up_vector(self.up)

    def reduced(self, factors: Sequence[int]) -> Capture:
        """Return the capture with images, masks and cameras reduced by a factor for each camera (C,), see
        :meth:`tk.model.cameras.camera.Camera.reduced`."""

        def smaller(clips: tuple[Clip, ...]) -> tuple[Clip, ...]:
            return tuple(clip.reduced(factor) for clip, factor in zip(clips, factors, strict=True))

        masks, empty = (clips and smaller(clips) for clips in (self.mask_clips, self.empty_clips))
        return replace(
            self, rig=self.rig.reduced(factors), clips=smaller(self.clips), mask_clips=masks, empty_clips=empty
        )

    def frames(self, start: int = 0, stop: int | None = None) -> FrameReader:
        """Return the frames ``start`` … ``stop - 1``, decoded ahead; up to the capture's end by default.

        Before :attr:`first_frame` a camera whose video begins later shows its first image.

        Raises:
            CaptureError: there are no such frames.
        """
        stop = self.frame_count if stop is None else min(stop, self.frame_count)
        if not 0 <= start < stop:
            raise CaptureError(
                f"{self.path}: no frames from {start} to {stop}; it has frames 0 to {self.frame_count - 1}"
            )
        return self.some_frames(range(start, stop))

    def some_frames(self, wanted: Sequence[int]) -> FrameReader:
        """Return the frames with these indices, ascending, decoded ahead."""
        return FrameReader(self.clips, self.mask_clips, self.rig.frame_shape, wanted, self.late_frames, self.fps)

    def images_of(self, cameras: Sequence[int], wanted: Sequence[int]) -> FrameReader:
        """Return the frames with these indices, ascending, with the images of some cameras, and no masks."""
        late = [self.late_frames[c] for c in cameras]
        return FrameReader([self.clips[c] for c in cameras], None, self.rig.frame_shape, wanted, late, self.fps)

    def background(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return the empty scene: an array (T, h, w, 3) uint8 BGR for each camera; None without `[background]` and
        without a `background/` folder.

        T is 1 for an image. Of a clip the first 32 frames are used; fewer, but at least 8, of many or large images,
        and fewer still if they would exceed 400 MB.

        Raises:
            VideoError: a camera has no background, or it cannot be read, or has another size.
        """
        folder, small = inherited(self.path, "background"), self.empty_clips
        if small is None and not folder.is_dir():
            return None
        if small is None:
            clips = clips_of(self.calibration, folder, "background", "png", pictures=True)
            small = tuple(clip.reduced(camera.reduction) for clip, camera in zip(clips, self.rig, strict=True))
        pixels = sum(camera.width * camera.height for camera in self.rig)
        recorded = sum(camera.width * camera.height * camera.reduction**2 for camera in self.rig)
        most = min(_BACKGROUND_FRAMES, max(_LEAST_BACKGROUND, _BACKGROUND_PIXELS // recorded))
        most = min(most, max(2, _BACKGROUND_BYTES // (3 * pixels)))
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            return tuple(threads.map(lambda clip: read_some(clip, most), small))


def open_capture(
    path: str | Path, cameras: Sequence[str] | None = None, masks: str = "auto", resample: bool = False
) -> Capture:
    """Open a capture folder.

    Args:
        path: the folder.
        cameras: names of the cameras to use; all of them by default.
        masks: "auto" takes the capture's `masks/` where there is one; "none" and "median" take no masks, and leave it
            to :mod:`tk.run.segmentation` to make some; anything else is a folder in the layout of `masks/`.
        resample: choose each frame's images by their time stamps, for cameras of different or variable rates.

    Raises:
        CaptureError: or one of its subclasses, with one line that names the file and what is wrong with it.
    """
    path, masks_asked = Path(path), masks
    if not path.is_dir():
        raise CaptureError(f"{path}: is not a folder; a capture is a folder with calibration.toml and videos/")
    if is_session(path):
        raise CaptureError(
            f"{path}: is a session of {len(trials(path))} captures; give one of them, or track all of them: "
            f"tk batch {path} -o FOLDER"
        )
    known = read_calibration(inherited(path, "calibration.toml"))
    calibration, file = known.select(cameras), path / "capture.toml"
    rig = calibration.rig
    settings = read_settings(file)
    regular = settings.fps if settings.times == "fps" else None
    if settings.videos:
        clips, given = referred_clips(path, settings.videos, calibration, known)
        stamps = referred_stamps(clips, given, regular)
    else:
        clips = open_clips(calibration, path)
        stamps = read_stamps(path, calibration, clips, regular)
    mask_clips = open_masks(calibration, path, masks)
    warnings: list[str] = [*settings.inherited, *calibration.notes, *notes_on(clips)]
    if settings.unknown:
        warnings.append(f"{file}: unknown keys are ignored: {', '.join(settings.unknown)}")
    warn_of_units(calibration, warnings.append)
    offsets = calibration.time_offset_s or (0.0,) * len(rig)
    timed: OnClock | None = None
    if resample or settings.videos or settings.span != Span():
        timed = _timed(path, settings, (clips, mask_clips), stamps, calibration, warnings.append)
        clips, mask_clips, fps, offsets = timed.clips, timed.masks, timed.clock.fps, timed.late_s
    else:
        found = check_clock(stamps, settings.fps, file, warnings.append)
        if found is None:
            warnings.append(f"{file}: gives no fps, and neither do the pictures; {DEFAULT_FPS:g} is assumed")
        fps = found or DEFAULT_FPS
    frame_count = _common_length(
        [*clips, *(mask_clips or ())], [round(late * fps) for late in offsets], warnings.append
    )
    if settings.init_frame >= frame_count:
        raise CaptureError(f"{file}: [init]: frame = {settings.init_frame} is past the last frame, {frame_count - 1}")
    return Capture(
        path=path,
        name=settings.name or text_of(path.resolve().name),
        fps=fps,
        up=up_of(settings, calibration.mounting, path, warnings.append),
        rig=rig,
        volume=volume_of(settings, rig, path, warnings.append),
        frame_count=frame_count,
        subjects=settings.subjects,
        init_frame=settings.init_frame,
        init_pose=settings.init_pose,
        init_keypoints=path / settings.init_keypoints if settings.init_keypoints else None,
        warnings=tuple(warnings),
        clips=clips,
        mask_clips=mask_clips,
        masks=masks_asked,
        clock=None if timed is None else timed.clock,
        empty_clips=None if timed is None else timed.empty,
        calibration=calibration,
        time_offset_s=offsets,
    )


def _timed(
    path: Path,
    settings: CaptureSettings,
    images: tuple[tuple[Clip, ...], tuple[Clip, ...] | None],
    stamps: Sequence[Stamps | None],
    calibration: Calibration,
    warn: Callable[[str], None],
) -> OnClock:
    """Return the ``images``, and masks, of a capture on a clock; delays of the calibration move the time stamps."""
    if settings.span.empty and (path / "background").is_dir():
        raise CaptureError(
            f"{path / 'capture.toml'}: has [background], and the folder background/ is there, too; keep one of them"
        )
    late = calibration.time_offset_s or (0.0,) * len(stamps)
    moved = [each and (each.moved(own) if any(late) else each) for each, own in zip(stamps, late, strict=True)]
    recorded = dict(zip(calibration.rig.names, zip(images[0], moved, strict=True), strict=True))
    return put_on_clock(recorded, images[1], settings, path / "capture.toml", warn)


def _common_length(clips: Sequence[Clip], late: Sequence[int], warn: Callable[[str], None]) -> int:
    """Return the number of frames until the first clip ends; ``late``: delays of the videos, which come first."""
    counts = [clip.frame_count + late[i % len(late)] for i, clip in enumerate(clips)]
    common = min(counts)
    if common <= max(0, *late):
        raise CaptureError(
            f"{clips[counts.index(common)].path}: ends before all cameras have begun; check time_offset in the "
            "calibration"
        )
    if any(late):
        first, last = max(0, *late), common - 1
        delays = ", ".join(f"{clip.path.stem} {n:+d}" for clip, n in zip(clips, late, strict=False) if n)
        warn(f"time offsets: {delays} frames; all cameras have pictures of frames {first} to {last}")
        return common
    if common < max(counts):
        short = ", ".join(str(clip.path) for clip in clips if clip.frame_count == common)
        warn(f"{short}: has {common} frames, others up to {max(counts)}; only the first {common} are used")
    return common
