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

from tk.model.masks.sightings import Sighting
from tk.segmenters.weights import weights

_DETECTOR_SIDE, _POSE_SIDE = 224, 256

# one network is loaded at a time: the process's stderr is closed meanwhile
_LOADING = threading.Lock()

# The detector's anchors: cells per side of each grid, and anchors per cell (MediaPipe's pose_detection_cpu.pbtxt:
# strides 8, 16, 32, 32, 32, two anchors each).
_GRIDS = ((28, 2), (14, 2), (7, 6))
# columns: middle and size of the box, mid-hip point, point on the circle around the body
_BOX, _SIZE, _HIPS, _CIRCLE = (slice(k, k + 2) for k in range(0, 8, 2))
_LEAST_SCORE = 0.5  # MediaPipe's value
# Least probability that the square shows a person. Of people who hide each other, landmarks with 0.24 are right.
_LEAST_PRESENT = 0.05
# The pose network's points, each with x, y, z, visibility, presence (MediaPipe's tensors_to_pose_landmarks).
_POINTS, _COLUMNS = 39, 5
_VISIBLE = 3  # column, a logit
_WORLD = 3  # columns of the points in space: metres from the middle of the hips, along the image's axes and away
# Rows of the network's points that correspond to a point of the body; the eyes are their centres.
_ROWS = {
    "nose": 0, "eye_l": 2, "eye_r": 5, "ear_l": 7, "ear_r": 8, "shoulder_l": 11, "shoulder_r": 12, "elbow_l": 13,
    "elbow_r": 14, "wrist_l": 15, "wrist_r": 16, "hip_l": 23, "hip_r": 24, "knee_l": 25, "knee_r": 26, "ankle_l": 27,
    "ankle_r": 28, "heel_l": 29, "heel_r": 30, "toe_l": 31, "toe_r": 32,
}  # fmt: skip
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

    landmarks = tuple(_ROWS)
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
        square, scale = _in_square(image, _DETECTOR_SIDE)
        found = self._network("pose_detection")(square / np.float32(127.5) - 1)
        rows, logits = (found[i][0] for i in np.argsort([-array.shape[-1] for array in found]))
        scores = 1 / (1 + np.exp(-np.clip(logits[:, 0].astype(np.float64), -100, 100)))
        sure = np.flatnonzero(scores >= _LEAST_SCORE)
        sure = sure[np.argsort(-scores[sure], kind="stable")]
        anchors = self._anchors[sure] * _DETECTOR_SIDE
        box, hips, circle = ((rows[sure, part] + anchors) / scale - 0.5 for part in (_BOX, _HIPS, _CIRCLE))
        weight, people = scores[sure], []
        for same in suppressed(box, rows[sure, _SIZE] / scale):
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
        square, scale = _in_square(image, _POSE_SIDE)
        found = self._network("pose_landmark_full")(square / np.float32(255))
        (logits,) = (a for a in found if a.shape[1:3] == (_POSE_SIDE,) * 2)
        (rows,) = (a.reshape(-1, _COLUMNS) for a in found if a.size == _POINTS * _COLUMNS)
        used = rows[list(_ROWS.values())].astype(np.float64)
        (world,) = (a.reshape(-1, _WORLD) for a in found if a.size == _POINTS * _WORLD)
        depth = world[list(_ROWS.values()), 2].astype(np.float64)
        landmarks = np.column_stack([(used[:, :2] + 0.5) / scale - 0.5, _probability(used[:, _VISIBLE]), depth])
        (present,) = (float(a.item()) for a in found if a.size == 1)
        landmarks[:, 2] *= present
        if not present >= _LEAST_PRESENT:
            landmarks[:] = np.nan
        side = max(height, width)
        # enlarged before thresholding, so that the outline is finer than the network's pixels
        whole = cv2.resize(logits[0, :, :, 0], (side, side), interpolation=cv2.INTER_LINEAR)
        return np.asarray(_probability(whole[:height, :width]), np.float32), landmarks


class _Network:
    """A TensorFlow Lite network with one input (1, n, n, 3)."""

    def __init__(self, path: Path) -> None:
        from ai_edge_litert.interpreter import Interpreter

        with _LOADING, _silent():
            self._interpreter = Interpreter(str(path), num_threads=1)
            self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
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
