"""Convert linear light to the bytes of a cheap machine-vision camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

GAMMA = 2.2


@dataclass(frozen=True)
class Sensor:
    """One camera's electronics and lens.

    Attributes:
        gain: (3,) RGB, exposure times white balance.
        blur_px: standard deviation of the defocus.
        read_noise: grey levels, of 255, after gamma.
        shot_noise: grey levels at full white.
        flicker: relative amplitude of the mains lamps' beat with the frame rate.
        phase: of that beat, radians.
    """

    gain: NDArray[np.float32]
    blur_px: float
    read_noise: float
    shot_noise: float
    flicker: float
    phase: float

    @staticmethod
    def draw(rng: np.random.Generator, width: int) -> Sensor:
        """Return a sensor with random settings."""
        balance = rng.uniform(0.93, 1.07, 3) * rng.uniform(0.9, 1.12)
        return Sensor(
            balance.astype(np.float32),
            float(rng.uniform(0.45, 0.7)) * width / 640,
            float(rng.uniform(1.4, 2.0)),
            float(rng.uniform(1.8, 2.6)),
            float(rng.uniform(0.004, 0.012)),
            float(rng.uniform(0, 2 * np.pi)),
        )

    def expose(self, linear: NDArray[np.float32], frame: int, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Convert linear RGB (H, W, 3) to RGB bytes (H, W, 3) of frame number ``frame``."""
        image = cv2.GaussianBlur(linear, (0, 0), self.blur_px) if self.blur_px > 0.1 else linear
        beat = 1.0 + self.flicker * np.sin(2.4 * frame + self.phase)
        level = np.clip(image * self.gain * np.float32(beat), 0.0, 1.0) ** np.float32(1 / GAMMA) * 255
        sigma = np.sqrt(self.read_noise**2 + self.shot_noise**2 * level / 255)
        level += sigma * rng.standard_normal(level.shape, dtype=np.float32)
        return np.clip(np.rint(level), 0, 255).astype(np.uint8)
