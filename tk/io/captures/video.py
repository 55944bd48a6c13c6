"""The images of one camera, read in order: a video file, a folder of numbered images, or a single image."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.paths import c_name

# OpenCV and FFmpeg write nothing to the terminal, unless the user sets these variables: errors here name the file.
# FFmpeg's level is read when the first video is opened; -8 is its AV_LOG_QUIET. OpenCV reads its own on import.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
if "OPENCV_LOG_LEVEL" not in os.environ:
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)  # OpenCV 4, OpenCV 5

Image = NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pbm", ".pgm", ".ppm")

#: least grey value of the foreground in a mask: half of 255, because video coding blurs edges
MASK_THRESHOLD = 128

_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG


class Reader(Protocol):
    """Reads the images of a clip in order. One thread at a time."""

    def read(self, out: Image) -> None:
        """Write the next image into ``out``: (H, W, 3) BGR, or (H, W) with 0 and 255 for a mask.

        Raises:
            VideoError: there is no next image, it cannot be decoded, or its size differs.
        """

    def skip(self) -> None:
        """Skip the next image. Raises as :meth:`read` does."""

    def close(self) -> None: ...


class Clip(Protocol):
    """A sequence of images on disk.

    Attributes:
        path: the file or folder, as messages name it.
        width, height: pixels; of a video or folder that is reduced, ``recorded_size`` is its own (width, height).
        frame_count: number of images.
        times_s: (N,) times of the images, seconds, increasing; None if the clip gives none.
    """

    @property
    def path(self) -> Path: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def frame_count(self) -> int: ...
    @property
    def times_s(self) -> NDArray[np.float64] | None: ...

    def open(self) -> Reader:
        """Return a reader at the first image."""

    def shown(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of the image that each frame shows, the nearest before the start and after the end; -1 if
        the frame is blank."""

    def reduced(self, factor: int) -> Clip:
        """Return the same images, reduced as :meth:`tk.model.cameras.camera.Camera.reduced` says. A mask's pixel shows
        the person if at least half of its square does."""


@dataclass(frozen=True)
class VideoClip:
    """A video file. See :class:`Clip`; make one with :func:`probe_video`."""

    path: Path
    width: int
    height: int
    frame_count: int
    times_s: NDArray[np.float64] | None = field(compare=False)
    is_mask: bool = False
    recorded_size: tuple[int, int] | None = None
    turned: bool = False  # whether the file asks for its coded images to be turned

    def open(self) -> Reader:
        return _open_planes(self) or _VideoReader(self)

    def shown(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.clip(frames, 0, self.frame_count - 1)

    def reduced(self, factor: int) -> VideoClip:
        return replace(self, **_reduced_size(self, factor))


@dataclass(frozen=True)
class PictureClip:
    """Numbered pictures in a folder, or one picture. See :class:`Clip`; make one with :func:`probe_pictures`."""

    path: Path
    width: int
    height: int
    files: tuple[Path, ...]
    is_mask: bool = False
    times_s: None = None
    recorded_size: tuple[int, int] | None = None

    @property
    def frame_count(self) -> int:
        return len(self.files)

    def open(self) -> Reader:
        return _PictureReader(self)

    def shown(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.clip(frames, 0, self.frame_count - 1)

    def reduced(self, factor: int) -> PictureClip:
        return replace(self, **_reduced_size(self, factor))


def probe(path: Path, is_mask: bool = False) -> Clip:
    """Return the clip at ``path``, of either kind. Its first image has been decoded as a check."""
    if path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES:
        return probe_pictures(path, is_mask)
    return probe_video(path, is_mask)


def probe_video(path: Path, is_mask: bool = False) -> VideoClip:
    """Open a video file and decode its first image.

    Frames are counted, and their times read, from the coded packets without decoding (about 10 µs a frame): the header
    of an `.mkv` is only an estimate, and the header of a truncated file counts all frames.

    Raises:
        VideoError: no video, empty, cut off, or of a codec that OpenCV cannot decode.
    """
    capture = _open_video(path)
    try:
        promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        turned = capture.get(cv2.CAP_PROP_ORIENTATION_META) != 0
        ok, picture = capture.read()
    finally:
        capture.release()
    if not ok:
        raise VideoError(f"{path}: no picture in it can be decoded; re-encode it, e.g. as H.264")
    times_s = _packet_times(path)
    frame_count = len(times_s)
    # one percent: headers that give a duration only are rounded
    if frame_count < promised - max(1, promised // 100):
        raise VideoError(
            f"{path}: is cut off: {frame_count} of its {promised} frames are there; copy it again, or re-encode it"
        )
    height, width = picture.shape[:2]
    increasing = bool((np.diff(times_s) > 0).all())
    times = times_s if increasing else None
    return VideoClip(path, width, height, frame_count, times, is_mask, turned=turned)


def probe_pictures(path: Path, is_mask: bool = False) -> PictureClip:
    """List the numbered images of a folder, or take one image file, and decode the first.

    The number stands at the end of the file's name. The first number is 0 or 1, and there are no gaps.

    Raises:
        VideoError: no pictures, a gap in the numbers, a number used twice, or the first cannot be decoded.
    """
    files = _numbered_pictures(path) if path.is_dir() else (path,)
    height, width = _read_picture(files[0], is_mask).shape[:2]
    return PictureClip(path, width, height, files, is_mask)


def damaged_images(path: Path, stop: int) -> list[int]:
    """Return the images of a video before ``stop`` that FFmpeg decodes in part only. It fills them up without an error,
    so no reader notices."""
    import av  # slow to import, and only needed for a message
    import av.error

    found = []
    with av.open(c_name(path, VideoError)) as container:
        container.streams.video[0].thread_type = "AUTO"
        try:
            for i, image in enumerate(islice(container.decode(video=0), stop)):
                if image.is_corrupt:
                    found.append(i)
        except av.error.FFmpegError:
            pass  # a reader fails here, too
    return found


def list_clips(folder: Path, pictures: bool = False) -> dict[str, Path]:
    """Return the video files, folders of images and, with ``pictures``, single images in a folder, by stem.

    Raises:
        VideoError: the same stem twice.
    """
    suffixes = VIDEO_SUFFIXES + (PICTURE_SUFFIXES if pictures else ())
    clips: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in suffixes):
            continue
        if path.is_dir() and path.suffix.lower() in VIDEO_SUFFIXES:
            raise VideoError(f"{path}: is a folder with the name of a video; rename it, or put the video in its place")
        stem = path.name if path.is_dir() else path.stem
        if stem in clips:
            raise VideoError(f"{folder}: holds both {clips[stem].name} and {path.name}; keep the one that is meant")
        clips[stem] = path
    return clips


def picture_number(path: Path) -> int | None:
    """Return the number at the end of an image's name; None without one."""
    digits = re.search(r"[0-9]+$", path.stem)
    return int(digits.group()) if digits else None


class _VideoReader:
    def __init__(self, clip: VideoClip) -> None:
        self._clip = clip
        self._index = 0
        self._capture = _open_video(clip.path)
        self._whole: NDArray[Any] | None = None  # memory of the last recorded image

    def skip(self) -> None:
        # no seeking: depending on codec and FFmpeg version it lands on key frames, or is off by one
        if not self._capture.grab():
            self._fail()
        self._index += 1

    def read(self, out: Image) -> None:
        clip = self._clip
        # OpenCV decodes directly into a suitable array, and allocates its own otherwise
        whole = self._whole if clip.is_mask or clip.recorded_size or not out.flags.c_contiguous else out
        ok, picture = self._capture.read(whole)
        if not ok:
            self._fail()
        self._index += 1
        if whole is not out:
            self._whole = picture
        _deliver(clip, picture, clip.path, out)

    def close(self) -> None:
        self._capture.release()

    def _fail(self) -> None:
        raise _undecodable(self._clip, self._index)


def _open_planes(clip: VideoClip) -> _PlaneReader | None:
    """Return a reader of the planes of a reduced video, None for a video that is left to OpenCV.

    These are: full size, masks, turned images, and, because they are rare, colours at full size, more than 8 bits, and
    sizes that the reduction divides with a remainder.
    """
    if not clip.recorded_size or clip.is_mask or clip.turned:
        return None
    import av  # slow to import, and small videos do without

    container = av.open(c_name(clip.path, VideoError))
    context = container.streams.video[0].codec_context
    context.thread_count = 1  # as in _open_video
    factor = clip.recorded_size[0] // clip.width
    divided = (factor * clip.width, factor * clip.height) == clip.recorded_size
    if divided and clip.width % 2 == clip.height % 2 == 0 and context.pix_fmt in ("yuv420p", "yuvj420p"):
        return _PlaneReader(clip, container)
    container.close()
    return None


class _PlaneReader:
    """Reads a reduced video. The planes of brightness and colour are reduced before they become BGR.

    Measured on 1920×1080, read at half the size: 3.8 ms an image, of which decoding is 3.3. OpenCV at full size and a
    reduction after it take 5.2 ms.
    """

    def __init__(self, clip: VideoClip, container: Any) -> None:
        self._clip = clip
        self._index = 0
        self._container = container
        self._images = container.decode(video=0)
        # brightness, and below it the two colours, as COLOR_YUV2BGR_I420 expects them
        self._planes = np.empty((clip.height * 3 // 2, clip.width), np.uint8)
        colors = self._planes[clip.height :].reshape(2, clip.height // 2, clip.width // 2)
        self._small = (self._planes[: clip.height], *colors)

    def _next(self) -> Any:
        import av.error

        try:
            image = next(self._images)
        except (av.error.FFmpegError, StopIteration):
            raise _undecodable(self._clip, self._index) from None
        self._index += 1
        return image

    def skip(self) -> None:
        self._next()

    def read(self, out: Image) -> None:
        image = self._next()
        _check_size(self._clip, image.width, image.height, self._clip.path)
        full_range = image.color_range == _FULL_RANGE or image.format.name == "yuvj420p"
        for k, (plane, small) in enumerate(zip(image.planes, self._small, strict=True)):
            whole = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
            cv2.resize(whole, small.shape[::-1], dst=small, interpolation=cv2.INTER_AREA)
            if full_range:  # to the range that the conversion expects: 16 to 235, and 16 to 240 about 128
                scale = (219 if k == 0 else 224) / 255
                cv2.convertScaleAbs(small, dst=small, alpha=scale, beta=16 if k == 0 else 128 * (1 - scale))
        cv2.cvtColor(self._planes, cv2.COLOR_YUV2BGR_I420, dst=out)

    def close(self) -> None:
        self._container.close()


def _undecodable(clip: Clip, index: int) -> VideoError:
    return VideoError(
        f"{clip.path}: image {index} of {clip.frame_count} cannot be decoded: the file is cut off or damaged; "
        "copy it again, or use the frames before",
        hint=f"with --frames 0:{index}",
    )


class _PictureReader:
    def __init__(self, clip: PictureClip) -> None:
        self._clip = clip
        self._index = 0

    def skip(self) -> None:
        self._index += 1

    def read(self, out: Image) -> None:
        clip = self._clip
        if self._index >= len(clip.files):
            raise VideoError(f"{clip.path}: has no picture number {self._index}; it holds {len(clip.files)}")
        path = clip.files[self._index]
        picture = _read_picture(path, clip.is_mask)
        self._index += 1
        if clip.is_mask and picture.max(initial=0) == 1:
            raise VideoError(f"{path}: holds the values 0 and 1; a mask's person is white, 255")
        _deliver(clip, picture, path, out)

    def close(self) -> None:
        pass


def _open_video(path: Path) -> cv2.VideoCapture:
    if path.exists() and not path.is_file():  # OpenCV would wait for a pipe
        raise VideoError(f"{path}: is not a file")
    # one decoding thread: the cameras are decoded in parallel already (measured: 5 % faster on 2 cores, less memory)
    capture = cv2.VideoCapture(c_name(path, VideoError), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    if not capture.isOpened():
        raise VideoError(f"{path}: {_why_unreadable(path)}")
    return capture


def _why_unreadable(path: Path) -> str:
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError as reason:
        return f"cannot be read ({reason.strerror or reason})"
    if not head:
        return "is an empty file; copy it again"
    if _has_sound_only(path):
        return "holds sound, but no video; put the camera's video in its place"
    if head[4:8] in (b"ftyp", b"mdat", b"wide", b"free"):
        return "is cut off: the index at its end is missing; copy it again, or finish the recording"
    return "is not a video that can be decoded; put a video file in its place"


def _has_sound_only(path: Path) -> bool:
    """Return whether a file has streams, but none of images."""
    import av  # slow to import, and only needed for this message

    try:
        with av.open(str(path)) as container:
            return len(container.streams) > 0 and not container.streams.video
    except (OSError, ValueError):  # base classes of PyAV's errors
        return False


def _packet_times(path: Path) -> NDArray[np.float64]:
    """Return the times (N,) of the coded images in a video file, seconds, ascending."""
    raw = -1  # CAP_PROP_FORMAT's way to ask for packets
    capture = cv2.VideoCapture(c_name(path, VideoError), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, raw])
    times: list[float] = []
    try:
        while capture.grab():
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    finally:
        capture.release()
    return 1e-3 * np.sort(times)  # some codecs store images in another order


def _numbered_pictures(folder: Path) -> tuple[Path, ...]:
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.suffix.lower() not in PICTURE_SUFFIXES:
            continue
        number = picture_number(path)
        if number is None:
            raise VideoError(f"{path}: its name has no number at the end; pictures are called 000000.png, 000001.png …")
        if number in files:
            raise VideoError(f"{folder}: both {files[number].name} and {path.name} are picture {number}; keep one")
        files[number] = path
    if not files:
        raise VideoError(f"{folder}: holds no pictures; they are called 000000.png, 000001.png …")
    numbers = sorted(files)
    if numbers[0] > 1:
        raise VideoError(f"{folder}: starts with {files[numbers[0]].name}; the first picture has number 0 (or 1)")
    for expected, number in enumerate(numbers, numbers[0]):
        if number != expected:
            raise VideoError(
                f"{folder}: picture {expected} is missing between {files[expected - 1].name} and {files[number].name}"
            )
    return tuple(files[number] for number in numbers)


def _read_picture(path: Path, is_mask: bool) -> NDArray[Any]:
    if not path.is_file():
        raise VideoError(f"{path}: there is no such file")
    coded = path.read_bytes()
    picture = None
    if _has_end(coded):
        flags = cv2.IMREAD_GRAYSCALE if is_mask else cv2.IMREAD_COLOR
        picture = cv2.imdecode(np.frombuffer(coded, np.uint8), flags)
    if picture is None:
        raise VideoError(f"{path}: is not a picture that can be decoded, or is cut off")
    return picture


def _has_end(coded: bytes) -> bool:
    """Return False for a truncated PNG or JPEG: OpenCV would fill up a JPEG with grey, libpng would print an error."""
    if not coded:
        return False
    if coded.startswith(b"\x89PNG"):
        return b"IEND" in coded
    return not coded.startswith(b"\xff\xd8") or b"\xff\xd9" in coded


def _deliver(clip: VideoClip | PictureClip, picture: NDArray[Any], path: Path, out: Image) -> None:
    """Write a recorded image into ``out``, reduced as the clip says.

    Raises:
        VideoError: the image has another size than the clip.
    """
    height, width = picture.shape[:2]
    _check_size(clip, width, height, path)
    if clip.is_mask:
        picture = _binarised(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    if clip.recorded_size:
        factor = width // clip.width
        whole = picture[: factor * clip.height, : factor * clip.width]
        picture = np.asarray(cv2.resize(whole, (clip.width, clip.height), interpolation=cv2.INTER_AREA))
        if clip.is_mask:
            picture = _binarised(picture)
    if not np.may_share_memory(picture, out):
        out[...] = picture


def _check_size(clip: VideoClip | PictureClip, width: int, height: int, path: Path) -> None:
    expected = clip.recorded_size or (clip.width, clip.height)
    if (width, height) != expected:
        raise VideoError(f"{path}: is {width}×{height}; the pictures before it are {expected[0]}×{expected[1]}")


def _reduced_size(clip: VideoClip | PictureClip, factor: int) -> dict[str, Any]:
    """Return what changes in a clip whose images are reduced, see :meth:`Clip.reduced`."""
    if factor == 1:
        return {}
    size = {"width": clip.width // factor, "height": clip.height // factor}
    return {**size, "recorded_size": (clip.width, clip.height)}


def _binarised(grey: NDArray[Any]) -> Image:
    return np.asarray(cv2.threshold(grey, MASK_THRESHOLD - 1, 255, cv2.THRESH_BINARY)[1], np.uint8)
