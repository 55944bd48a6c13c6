"""MediaPipe's pose networks (BlazePose; Bazarevsky et al. 2020), run with LiteRT: detect people, segment one person.

The detector returns each person's mid-hip point and the radius of a circle around it that contains the whole body. The
pose network gets an upright square with one person and returns landmarks and a mask of 256×256. The pre- and
postprocessing is that of MediaPipe, with two differences: no state is kept between frames, and the caller, who has
several cameras, chooses the square.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_points import LANDMARKS
from tk.model.masks.sightings import Sighting
from tk.segmenters.weights import weights

# one network is loaded at a time: the process's stderr is closed meanwhile
_LOADING = threading.Lock()

# The detector's anchors: cells per side of each grid, and anchors per cell (MediaPipe's pose_detection_cpu.pbtxt:
# strides 8, 16, 32, 32, 32, two anchors each).
_GRIDS = ((28, 2), (14, 2), (7, 6))
_LEAST_SCORE = 0.5  # MediaPipe's value
# Least probability that the square shows a person. Of people who hide each other, landmarks with 0.24 are right.
_LEAST_PRESENT = 0.05
# The pose network's points, in order; the eyes are their centres.
_POINTS = (
    "nose", "eye_inner_l", "eye_l", "eye_outer_l", "eye_inner_r", "eye_r", "eye_outer_r", "ear_l", "ear_r", "mouth_l",
    "mouth_r", "shoulder_l", "shoulder_r", "elbow_l", "elbow_r", "wrist_l", "wrist_r", "pinky_l", "pinky_r",
    "index_l", "index_r", "thumb_l", "thumb_r", "hip_l", "hip_r", "knee_l", "knee_r", "ankle_l", "ankle_r", "heel_l",
    "heel_r", "toe_l", "toe_r",
)  # fmt: skip
_USED = [_POINTS.index(name) for name in LANDMARKS]
# Detections whose boxes, which hold the head, overlap by more (intersection over union) are one person: MediaPipe's
# value. The heads of two dancers are apart.
_SAME = 0.3


class BlazePose:
    """A :class:`~tk.segmenters.PoseSegmenter` and :class:`~tk.segmenters.Finder`.

    Each thread that calls it has its own networks, of one thread: with two threads a network takes 0.7 times as long,
    two images in two threads take 0.6 to 0.8 times as long. The results are the same bit for bit.

    Attributes:
        landmarks: names of the landmarks that :meth:`segment_pose` returns.
        parallel: see :class:`~tk.segmenters.Segmenter`.

    Raises:
        ConfigError: the weights are missing and cannot be downloaded.
    """

    landmarks = LANDMARKS
    parallel = True

    def __init__(self) -> None:
        self._files = weights()
        self._networks = threading.local()
        self._anchors = np.concatenate([_grid(cells, count) for cells, count in _GRIDS])

    def _network(self, name: str) -> _Network:
        """Return a network of this thread."""
        loaded: dict[str, _Network] = self._networks.__dict__
        if name not in loaded:
            loaded[name] = _Network(self._files[f"{name}.tflite"])
        return loaded[name]

    def find(self, image: NDArray[np.uint8]) -> list[Sighting]:
        """Return the people in an image (h, w, 3) BGR, the most certain first."""
        network = self._network("pose_detection")
        square, scale = _in_square(image, network.side)
        # of each anchor one number, and twelve: middle and size of the box, mid-hip point, point on the circle around
        # the body, two more
        logits, rows = sorted((array[0] for array in network(square / np.float32(127.5) - 1)), key=np.size)
        scores = 1 / (1 + np.exp(-np.clip(logits[:, 0].astype(np.float64), -100, 100)))
        sure = np.flatnonzero(scores >= _LEAST_SCORE)
        sure = sure[np.argsort(-scores[sure], kind="stable")]
        middle, size, hip, edge, *_ = np.moveaxis(rows.reshape(len(rows), -1, 2)[sure], 1, 0)
        anchors = self._anchors[sure] * network.side
        box, hips, circle = ((part + anchors) / scale - 0.5 for part in (middle, hip, edge))
        weight, people = scores[sure], []
        for same in suppressed(box, size / scale):
            share = weight[same, None] / weight[same].sum()
            x, y = (share * hips[same]).sum(axis=0)
            u, v = (share * circle[same]).sum(axis=0)
            people.append(Sighting((float(x), float(y)), (float(u), float(v)), float(weight[same[0]])))
        return people

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the probability (h, w) that each pixel shows the person in the middle of the image (h, w, 3)."""
        return self.segment_pose(image)[0]

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """See :class:`~tk.segmenters.PoseSegmenter`."""
        height, width = image.shape[:2]
        network = self._network("pose_landmark_full")
        square, scale = _in_square(image, network.side)
        found = network(square / np.float32(255))
        # Of each point three numbers in space, metres from the middle of the hips, along the image's axes and away; and
        # five in the image: x, y, z, visibility, presence (MediaPipe's tensors_to_pose_landmarks).
        present, world, points = (array[0] for array in sorted(found, key=np.size)[:3])
        x, y, _, visible, _ = points.reshape(-1, 5)[_USED].T.astype(np.float64)
        pixels = (np.stack([x, y], axis=1) + 0.5) / scale - 0.5
        depth = world.reshape(-1, 3)[_USED, 2].astype(np.float64)
        landmarks = np.column_stack([pixels, _probability(visible) * present, depth])
        if not present >= _LEAST_PRESENT:
            landmarks[:] = np.nan
        side = max(height, width)
        # enlarged before thresholding, so that the outline is finer than the network's pixels
        (logits,) = (array[0, :, :, 0] for array in found if array.shape[1:3] == square.shape[:2])
        whole = cv2.resize(logits, (side, side), interpolation=cv2.INTER_LINEAR)
        return np.asarray(_probability(whole[:height, :width]), np.float32), landmarks


class _Network:
    """A TensorFlow Lite network with one input (1, n, n, 3); ``side``: n."""

    def __init__(self, path: Path) -> None:
        from ai_edge_litert.interpreter import Interpreter

        with _LOADING, _silent():
            self._interpreter = Interpreter(str(path), num_threads=1)
            self._interpreter.allocate_tensors()
        (given,) = self._interpreter.get_input_details()
        self._input, self.side = given["index"], int(given["shape"][1])
        self._outputs = [detail["index"] for detail in self._interpreter.get_output_details()]

    def __call__(self, image: NDArray[np.floating]) -> list[NDArray[Any]]:
        """Return the outputs (1, …) for an image (n, n, 3)."""
        self._interpreter.set_tensor(self._input, image[None].astype(np.float32))
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(index) for index in self._outputs]


def suppressed(middle: NDArray[np.floating], size: NDArray[np.floating]) -> list[NDArray[np.int64]]:
    """Return the rows of each person's detections, the best first, by non-maximum suppression of boxes with these
    middles and sizes (N, 2), the most certain first."""
    low, high = middle - size / 2, middle + size / 2
    left, area, people = np.arange(len(middle)), size.prod(axis=1), []
    while len(left):
        first = left[0]
        common = np.maximum(np.minimum(high[left], high[first]) - np.maximum(low[left], low[first]), 0.0).prod(axis=1)
        same = (common > _SAME * (area[left] + area[first] - common)) | (left == first)
        people.append(left[same])
        left = left[~same]
    return people


def _probability(logit: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(1 / (1 + np.exp(-np.clip(logit, -50, 50))))


@contextmanager
def _silent() -> Iterator[None]:
    """Suppress LiteRT's messages on stderr; it has no setting for that."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _grid(cells: int, count: int) -> NDArray[np.float64]:
    """Return the centres of the anchors (cells² count, 2) x, y, as shares of the image."""
    y, x = np.mgrid[:cells, :cells] + 0.5
    return np.repeat(np.stack([x.ravel(), y.ravel()], axis=1) / cells, count, axis=0)


def _in_square(image: NDArray[np.uint8], side: int) -> tuple[NDArray[np.uint8], float]:
    """Return the image in RGB, scaled into the upper left of a black square (side, side, 3), and the scale."""
    height, width = image.shape[:2]
    largest = max(height, width)
    padded = cv2.copyMakeBorder(image, 0, largest - height, 0, largest - width, cv2.BORDER_CONSTANT)
    shrunk = cv2.INTER_AREA if largest > side else cv2.INTER_LINEAR
    small = cv2.resize(padded, (side, side), interpolation=shrunk)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), np.uint8), side / largest
