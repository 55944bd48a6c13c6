"""Write H.264 in MP4, which every browser plays, with PyAV in a separate thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ExportError
from tk.io.paths import Kind, replacing

Image = NDArray[np.uint8]

# Constant rate factor: 0 is lossless, 51 the worst; text and thin lines are readable at 28. Macroblock trees would make
# files a fifth smaller and 0.7 dB worse, and take a sixth longer.
_X264 = {"preset": "ultrafast", "crf": "28", "x264-params": "threads=1:mbtree=0:rc-lookahead=0:deblock=0,0"}
# images that may wait for the encoder; more would only need memory
_WAITING = 8
#: marks tk's files in their metadata
_COMMENT = "made by tk"


@contextmanager
def video_writer(path: Path, fps: float) -> Iterator[Callable[[Image], None]]:
    """Open a video for writing; yield a function that adds images (H, W, 3) BGR, H and W even, all of one size.

    PyAV releases the interpreter lock while it encodes, so the next image is drawn at the same time. The file gets its
    name when the block ends without an error.

    Args:
        path: the MP4 file. One that exists is replaced.
        fps: images per second.
    """
    with replacing(path) as part:
        encoder = _Encoder(part, fps)
        try:
            yield encoder.add
        finally:
            encoder.finish()
        encoder.check()


class _Encoder:
    """The encoding thread and its queue."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path = path
        self._fps = Fraction(fps).limit_denominator(1001)
        self._waiting: queue.Queue[Image | None] = queue.Queue(_WAITING)
        self._failure: Exception | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="tk-encode", daemon=True)
        self._thread.start()

    def add(self, picture: Image) -> None:
        self.check()
        # five times as fast as PyAV's conversion
        self._waiting.put(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), np.uint8))

    def finish(self) -> None:
        self._waiting.put(None)
        self._thread.join()

    def check(self) -> None:
        """Raise the exception of the thread, if there was one."""
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            self._encode()
        except Exception as error:  # raised when the next image is added
            self._failure = error
            while self._next() is not None:  # empty the queue, so that ``add`` never blocks
                pass

    def _next(self) -> Image | None:
        """Return the next image; None, also when asked again, after the last one."""
        picture = None if self._ended else self._waiting.get()
        self._ended = picture is None
        return picture

    def _encode(self) -> None:
        picture = self._next()
        if picture is None:
            return
        import av  # slow to import, and only needed here

        with av.open(str(self._path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            container.metadata["comment"] = _COMMENT
            stream: Any = container.add_stream("libx264", rate=self._fps, options=_X264)
            stream.height, stream.width = picture.shape[0] * 2 // 3, picture.shape[1]
            stream.pix_fmt = "yuv420p"
            while picture is not None:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="yuv420p")))
                picture = self._next()
            container.mux(stream.encode(None))


def made_here(path: Path) -> bool:
    """Return whether a video was written by :func:`video_writer`."""
    import av

    try:
        with av.open(str(path)) as container:
            return container.metadata.get("comment") == _COMMENT
    except (OSError, ValueError):  # base classes of PyAV's errors
        return False


VIDEO = Kind("a video of tk", (".mp4",), made_here)


def check_encoder() -> None:
    """Raise ExportError if PyAV is missing or cannot encode H.264."""
    try:
        import av.codec

        av.codec.Codec("libx264", "w")
    except (ImportError, ValueError) as error:
        raise ExportError(f"videos need PyAV with libx264: {error}; pip install av") from None
