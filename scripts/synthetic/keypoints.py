"""Simulated 2D keypoints: projected joints with noise and outliers, in files of OpenPose's format."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.keypoints import LAYOUTS
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]


def detect(
    camera_pixels: Float, rng: np.random.Generator, count: int, noise_px: float = 5.0, wrong: float = 0.1
) -> list[float]:
    """Return x, y, confidence of the ``count`` keypoints of one person, from joints (15, 2) pixels.

    Each has noise of ``noise_px`` (one standard deviation per direction); a share ``wrong`` of them lies anywhere in
    the person's box, with the same confidence. Keypoints that are not joints of tk are zeros.
    """
    numbers = np.zeros((count, 3))
    low, high = camera_pixels.min(axis=0), camera_pixels.max(axis=0)
    for name, k in LAYOUTS[count].items():
        place = camera_pixels[JOINTS.index(name)] + noise_px * rng.normal(size=2)
        if rng.random() < wrong:
            place = rng.uniform(low, high)
        numbers[k] = [*place, rng.uniform(0.5, 1.0)]
    return [float(number) for number in numbers.ravel()]


def write_keypoints(
    folder: Path,
    rig: Rig,
    frame: int,
    people: Sequence[Float],
    rng: np.random.Generator,
    count: int = 25,
    noise_px: float = 5.0,
    wrong: float = 0.1,
) -> None:
    """Write the files of one frame for all cameras; the order of the people (joints (15, 3) m) is random in each."""
    for camera in rig:
        found = [camera.project(joints)[0] for joints in people]
        order = rng.permutation(len(people))
        document = {
            "version": 1.3,
            "people": [
                {"person_id": [-1], "pose_keypoints_2d": detect(found[i], rng, count, noise_px, wrong)} for i in order
            ],
        }
        path = folder / camera.name / f"{camera.name}_{frame:012d}_keypoints.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document), encoding="utf-8")
