"""Read the videos or pictures of a board, find the board in them, and choose sharp and different instants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import Board
from tk.calibration.detection import Detection, detect
from tk.errors import CalibrationError
from tk.io.captures.capture_toml import read_settings
from tk.io.captures.clip import Clip
from tk.io.captures.clip_folder import list_clips
from tk.io.captures.clock import clips_on_clock
from tk.io.captures.frames import Images
from tk.io.captures.pictures import PICTURE_SUFFIXES, picture_number, read_picture
from tk.io.captures.video import VIDEO_SUFFIXES, probe_video

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: most images of the longest video that are searched for the board; more take longer and look alike
_LOOKS = 240
#: a view less sharp than this share of the camera's sharp ones (upper quartile) is blurred: its corners are off by more
#: than the noise
_BLURRED = 0.55
#: a view in which the board moves more than this from frame to frame is not used, pixels
_FASTEST_PX = 8.0
#: two views of a camera are alike if the mean distance of the board's corners is less than this share of the image's
#: width
_ALIKE = 0.015
#: images kept for the explanation if no board is found, and width of the pictures of the report, pixels
_SAMPLES, _THUMB_PX = 24, 420
#: fewest views of a camera: two determine a focal length only in theory
FEWEST_SEEN = 3


@dataclass(frozen=True)
class Seen:
    """The board in one image."""

    detection: Detection
    outline: Float  # (4, 2) pixels of the corners of the board
    motion_px: float  # motion from this frame to the next; 0 for pictures and the last frame
    picture: bytes  # a small JPEG of the image


@dataclass
class Footage:
    """What one camera recorded.

    Attributes:
        name, path: the camera, its video or folder of pictures.
        width, height: pixels.
        clip: the video whose frames are the instants; None: instants are numbers of pictures.
        instants: searched images, by instant.
        seen: the board, by instant.
        samples: grey images without a board, for the explanation, if there are too few with it.
        spacing: one of so many images becomes a sample.
    """

    name: str
    path: Path
    width: int = 0
    height: int = 0
    clip: Clip | None = None
    instants: list[int] = field(default_factory=list)
    seen: dict[int, Seen] = field(default_factory=dict)
    samples: list[Grey] = field(default_factory=list)
    spacing: int = 1


def list_cameras(folder: Path, note: Callable[[str], None]) -> dict[str, Path | Clip]:
    """Return the video or folder of pictures of each camera; the frames of a capture with `[videos]`.

    Raises:
        CalibrationError: the folder cannot be read, or there is no camera in it.
        CaptureError: its `[videos]` cannot be read.
    """
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: is not a folder; give the one with a folder or a video of each camera")
    settings = read_settings(folder / "capture.toml")
    if settings.videos:
        return dict(clips_on_clock(folder, settings, note))
    for inner in ("videos", "images"):  # as a capture has them
        if (folder / inner).is_dir() and not any((folder / inner / name).is_dir() for name in ("videos", "images")):
            clips = list_clips(folder / inner)
            if clips:
                return dict(clips)
    suffixes = PICTURE_SUFFIXES + VIDEO_SUFFIXES
    clips = {name: path for name, path in list_clips(folder).items() if not path.is_dir() or _files(path, suffixes)}
    if not clips:
        raise CalibrationError(f"{folder}: holds no cameras; it needs a folder of pictures or a video for each camera")
    return {name: _inside(path) for name, path in clips.items()}


def _files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Return the files in a folder with these suffixes, without hidden ones, such as those that macOS adds."""
    return [path for path in sorted(folder.iterdir()) if path.suffix.lower() in suffixes and path.name[0] != "."]


def _inside(path: Path) -> Path:
    """Return the one video in a camera's folder, if there is one; else the path."""
    if not path.is_dir():
        return path
    videos = _files(path, VIDEO_SUFFIXES)
    if len(videos) > 1:
        raise CalibrationError(f"{path}: holds {len(videos)} videos; keep the one that shows the board")
    return videos[0] if videos else path


def read_footage(
    folder: Path,
    board: Board,
    cameras: Sequence[str] | None,
    progress: Callable[[str], None],
    note: Callable[[str], None] = lambda _: None,
) -> tuple[list[Footage], Board]:
    """Find the board in the images of all cameras. ``note`` receives lines for the user.

    Returns:
        what the cameras recorded, and the board: that of its patterns which is found first.

    Raises:
        CalibrationError, VideoError: a camera's images cannot be read, or a name is unknown.
    """
    known = list_cameras(folder, note)
    for name in cameras or ():
        if name not in known:
            raise CalibrationError(f"{folder}: has no camera {name!r}; it has {', '.join(known)}")
    found = []
    for name, given in known.items():
        if cameras is None or name in cameras:
            path = given if isinstance(given, Path) else given.path
            clip = given if isinstance(given, Clip) else None if path.is_dir() else probe_video(path)
            found.append(Footage(name, path, clip=clip))
    longest = max((footage.clip.frame_count for footage in found if footage.clip), default=0)
    step = max(1, -(-longest // _LOOKS))  # of all cameras, so that their instants are the same
    patterns = board.patterns
    for number, footage in enumerate(found, start=1):
        progress(f"searching for the board in the images of {footage.name}, camera {number} of {len(found)}")
        for instant, grey, following in _images(footage, step):
            detections = [(pattern, detect(grey, pattern)) for pattern in patterns]
            shown, seen = max(detections, key=lambda one: 0 if one[1] is None else len(one[1].ids))
            if seen is not None:
                patterns = (shown,)
            _look(footage, shown, instant, grey, following, seen)
    return found, patterns[0]


def _images(footage: Footage, step: int) -> Iterator[tuple[int, Grey, Grey | None]]:
    """Yield the instants and grey images of a camera, and the frame after each if it is a video, of which one of
    ``step`` frames is an instant."""
    clip = footage.clip
    if clip is None:
        numbers: dict[int, Path] = {}
        for file in _files(footage.path, PICTURE_SUFFIXES):
            number = picture_number(file)
            if number is None:
                raise CalibrationError(f"{file}: its name has no number; pictures of one instant have the same number")
            if number in numbers:
                raise CalibrationError(f"{footage.path}: {numbers[number].name} and {file.name} have the same number")
            numbers[number] = file
        for number, file in sorted(numbers.items()):
            picture = _grey(read_picture(file, is_mask=False))
            height, width = picture.shape
            if footage.width and (width, height) != (footage.width, footage.height):
                size = f"{footage.width}×{footage.height}"
                raise CalibrationError(f"{file}: is {width}×{height}; the pictures before it are {size}")
            footage.width, footage.height = width, height
            yield number, picture, None
        return
    footage.width, footage.height = clip.width, clip.height
    wanted = np.array([k for k in range(clip.frame_count) if k % step <= 1])
    blank = (clip.shown(wanted) < 0).tolist()
    waiting: tuple[int, Grey] | None = None  # for the frame that follows
    out = np.empty((clip.height, clip.width, 3), np.uint8)
    with closing(Images(clip, wanted)) as images:
        for place, instant in enumerate(wanted.tolist()):
            grey: Grey | None = None
            if not blank[place]:
                images.read(place, out)
                grey = _grey(out)
            if waiting is not None:
                yield *waiting, grey
            waiting = (instant, grey) if grey is not None and instant % step == 0 else None
        if waiting is not None:
            yield *waiting, None


def _grey(picture: NDArray[Any]) -> Grey:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


def _look(
    footage: Footage, board: Board, instant: int, grey: Grey, following: Grey | None, found: Detection | None
) -> None:
    footage.instants.append(instant)
    if found is None:
        if len(footage.seen) < FEWEST_SEEN and len(footage.instants) % footage.spacing == 0:
            footage.samples.append(grey.copy())
            if len(footage.samples) > _SAMPLES:
                footage.samples, footage.spacing = footage.samples[1::2], 2 * footage.spacing
        return
    onto, _ = cv2.findHomography(board.points[found.ids, :2], found.pixels)
    outline = cv2.perspectiveTransform(board.corners[None, :, :2], onto)[0]
    scale = min(1.0, _THUMB_PX / footage.width)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
    motion = 0.0 if following is None else _motion(grey, following, found.pixels)
    footage.seen[instant] = Seen(found, outline, motion, picture)
    if len(footage.seen) >= FEWEST_SEEN:
        footage.samples = []


def _motion(grey: Grey, following: Grey, pixels: Float) -> float:
    """Return the median motion of points from one frame to the next, pixels."""
    before = pixels.astype(np.float32)[:, None]
    opencv: Any = cv2  # its stubs do not take None for the first guess
    after, ok, _ = opencv.calcOpticalFlowPyrLK(grey, following, before, None, winSize=(15, 15))
    moved = np.linalg.norm(after - before, axis=2).ravel()[ok.ravel() == 1]
    return float(np.median(moved)) if len(moved) >= len(pixels) / 2 else _FASTEST_PX + 1


def choose(footages: Sequence[Footage], most: int, always: int | None = None) -> tuple[dict[int, list[int]], list[str]]:
    """Choose the instants that show the board sharply and differently.

    Each round takes the instant whose views differ most from those chosen; a view that another camera shares counts
    twice.

    Args:
        footages: of all cameras.
        most: largest number of instants.
        always: an instant that is taken in any case.

    Returns:
        the cameras that show the board, by chosen instant; and the number of blurred and moving views in words.
    """
    usable: dict[int, list[int]] = {}
    left_out = []
    for c, footage in enumerate(footages):
        if not footage.seen:
            continue
        sharp = _BLURRED * float(np.percentile([seen.detection.sharpness for seen in footage.seen.values()], 75))
        blurred = moving = 0
        for instant, seen in footage.seen.items():
            if seen.motion_px > _FASTEST_PX:
                moving += 1
            elif seen.detection.sharpness < sharp:
                blurred += 1
            else:
                usable.setdefault(instant, []).append(c)
        if blurred or moving:
            left_out.append(f"camera {footage.name}: {blurred} blurred and {moving} fast views are not used")
    width = [max(footage.width, 1) for footage in footages]
    nearest = {(c, i): np.inf for i, cameras in usable.items() for c in cameras}
    chosen: dict[int, list[int]] = {}
    while usable and len(chosen) < most:
        weight = {i: (2 if len(cameras) > 1 else 1) for i, cameras in usable.items()}
        gain = {i: weight[i] * sum(nearest[c, i] for c in cameras) for i, cameras in usable.items()}
        best = always if always in usable and not chosen else max(gain, key=lambda i: (gain[i], -i))
        if gain[best] < _ALIKE * weight[best]:
            break
        chosen[best] = usable.pop(best)
        for c in chosen[best]:
            outline = footages[c].seen[best].outline
            for i, cameras in usable.items():
                if c in cameras:
                    apart = np.linalg.norm(footages[c].seen[i].outline - outline, axis=1).mean() / width[c]
                    nearest[c, i] = min(nearest[c, i], float(apart))
    return dict(sorted(chosen.items())), left_out
