"""A copy of a capture for `scripts/fault_kinds.py` to spoil: its videos, masks, calibration and description."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from tk.io.captures.calibration import camera_table, read_calibration
from tk.io.captures.capture import Capture
from tk.io.toml import load_toml
from tk.model.cameras.camera import Camera
from tk.run.segmentation import make_labeller
from tk.run.task import Task
from tk.settings import Settings

Image = NDArray[np.uint8]
Video = list[Image]


@dataclass
class Faulty:
    """A copy of a capture that gets a fault.

    Attributes:
        folder: the copy. Its files are links, so they must be replaced, not changed.
        original: the capture.
        camera: index of the faulty camera.
        begin: first frame of faults that do not last from the start.
        foreign: another capture with as many cameras; None: there is none.
        used: names of the cameras to track with; empty: all.
        cut: number of frames missing from :attr:`begin` on.
    """

    folder: Path
    original: Capture
    camera: int
    begin: int
    foreign: Path | None = None
    used: tuple[str, ...] = ()
    cut: int = 0

    @property
    def count(self) -> int:
        return self.original.frame_count

    @property
    def all(self) -> range:
        """Indices of all cameras."""
        return range(len(self.original.rig))

    @property
    def next(self) -> int:
        """Index of the camera after the faulty one."""
        return (self.camera + 1) % len(self.all)

    def video(self, camera: int) -> Path:
        clip = self.original.clips[camera].path
        return self.folder / clip.parent.name / clip.name

    def images(self, camera: int) -> Video:
        """Read all images of a camera, BGR."""
        clip = self.original.clips[camera]
        images = []
        with closing(clip.open()) as reader:
            for _ in range(clip.frame_count):
                image = np.empty((clip.height, clip.width, 3), np.uint8)
                reader.read(image)
                images.append(image)
        return images

    def write(self, path: Path, images: Sequence[Image], faster: int = 1, times: Sequence[int] | None = None) -> None:
        """Replace a video by these images.

        Args:
            path: the video.
            images: (H, W, 3) BGR each.
            faster: its rate in rates of the capture.
            times: of the images, in intervals of that rate; None: one after the other.
        """
        path.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=faster * Fraction(self.original.fps).limit_denominator(1000))
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "18", "preset": "veryfast"}
            for i, image in enumerate(images):
                frame = av.VideoFrame.from_ndarray(image, format="bgr24")
                frame.pts = i if times is None else times[i]
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    def change(
        self, edit: Callable[[Video], Sequence[Image]], cameras: Iterable[int] | None = None, faster: int = 1
    ) -> None:
        """Change the images of some cameras; None: of the faulty one."""
        for camera in [self.camera] if cameras is None else cameras:
            self.write(self.video(camera), edit(self.images(camera)), faster)

    def plate(self, camera: int) -> Image:
        """Return the camera's image of the empty scene."""
        clips = self.original.background()
        if clips is None:
            raise SystemExit(f"{self.original.path}: this fault needs background/")
        return np.asarray(np.median(clips[camera], axis=0), np.uint8)

    def masks(self) -> NDArray[np.uint8]:
        """Return (F, C, H, W) masks against the empty scene."""
        label = make_labeller(Task.of(self.original, Settings()), lambda _: None)
        with self.original.frames() as frames:
            return np.array([label(frame)[0] for frame in frames])

    def give_masks(self, edit: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]]) -> None:
        """Write masks into the copy; ``edit`` changes those of a camera, (F, h, w), given its index."""
        masks = self.masks()
        for c, camera in enumerate(self.original.rig):
            folder = self.folder / "masks" / camera.name
            folder.mkdir(parents=True)
            for i, mask in enumerate(edit(c, masks[:, c, : camera.height, : camera.width])):
                cv2.imwrite(str(folder / f"{i:06d}.png"), mask)

    def calibrate(self, edit: Callable[[int, Camera], Camera], **metadata: Any) -> None:
        """Change the cameras of `calibration.toml`; ``edit`` gets a camera's index, too."""
        path = self.folder / "calibration.toml"
        cameras = [edit(c, camera) for c, camera in enumerate(read_calibration(path).rig)]
        tables = {camera.name: camera_table(camera) for camera in cameras}
        path.unlink()
        path.write_text(tomli_w.dumps({**tables, "metadata": metadata}), encoding="utf-8")

    def describe(self, **entries: Any) -> None:
        """Change entries of `capture.toml`; None deletes one."""
        path = self.folder / "capture.toml"
        settings = load_toml(path) | entries
        path.unlink()
        path.write_text(tomli_w.dumps({k: v for k, v in settings.items() if v is not None}), encoding="utf-8")
