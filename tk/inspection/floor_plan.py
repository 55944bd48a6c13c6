"""The floor plan of `tk inspect`: the working volume, the cameras, and the people's paths from above."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.inspection.people import PersonReport
from tk.io.captures.capture import Capture
from tk.model.body.skeleton import up_rotation
from tk.render.canvas import LINE, write
from tk.render.palette import INK, PAPER, VOLUME, WIRE, person_color

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

#: layout of the floor plan, pixels: longest side, margin. Appearance only.
_SIDE, _MARGIN = 900, 60


def floor_plan(capture: Capture, people: Sequence[PersonReport]) -> Image:
    """Return the picture (h, w, 3) BGR of the floor from above: volume, cameras, and the people's paths.

    A number stands where a person was seen first, a dot at each further look, an arrow's head at the last.
    """
    to_plan = up_rotation(capture.up).T[:2]
    box = np.array(np.meshgrid(*zip(capture.volume.lower, capture.volume.upper, strict=True))).reshape(3, -1).T
    paths = [np.array(person.path) @ to_plan.T for person in people]
    centers = capture.rig.centers @ to_plan.T
    shown = np.concatenate([box @ to_plan.T, centers, *paths])
    low, high = shown.min(axis=0), shown.max(axis=0)
    scale = _SIDE / float((high - low).max())
    width, height = (round(float(side)) for side in (high - low) * scale + 2 * _MARGIN)
    image = np.full((height + LINE * (len(people) + 2), max(width, _SIDE), 3), PAPER, np.uint8)

    def pixel(point: Float) -> tuple[int, int]:
        x, y = (point - low) * scale + _MARGIN
        return round(float(x)), height - round(float(y))

    corners = cv2.convexHull(np.array([pixel(corner) for corner in box @ to_plan.T]))
    cv2.polylines(image, [corners], True, VOLUME, 2, cv2.LINE_AA)
    for camera, center in zip(capture.rig, centers, strict=True):
        ahead = camera.rotation[2] @ to_plan.T
        x, y = pixel(center)
        cv2.circle(image, (x, y), 6, WIRE, cv2.FILLED, cv2.LINE_AA)
        cv2.line(image, (x, y), pixel(center + 0.3 * ahead), WIRE, 2, cv2.LINE_AA)
        write(image, camera.name, x + 9, y - 6, WIRE)
    for person, path in zip(people, paths, strict=True):
        color = person_color(person.number)
        pixels = [pixel(point) for point in path]
        for start, stop in pairwise(pixels):
            cv2.line(image, start, stop, color, 2, cv2.LINE_AA)
        for point in pixels:
            cv2.circle(image, point, 3, color, cv2.FILLED, cv2.LINE_AA)
        if len(pixels) > 1 and pixels[-1] != pixels[-2]:
            cv2.arrowedLine(image, pixels[-2], pixels[-1], color, 3, cv2.LINE_AA, tipLength=0.9)
        cv2.circle(image, pixels[0], 12, color, cv2.FILLED, cv2.LINE_AA)
        write(image, str(person.number), pixels[0][0] - 5, pixels[0][1] + 5, PAPER, 0.5)
    metre = round(scale)
    cv2.line(image, (_MARGIN, height - 14), (_MARGIN + metre, height - 14), INK, 2)
    write(image, "1 m", _MARGIN + metre + 8, height - 10, INK)
    x, y = corners.reshape(-1, 2).min(axis=0).tolist()
    write(image, "working volume", x, y - 8, VOLUME)
    for k, person in enumerate(people):
        write(image, person.line(len(capture.rig)), 10, height + LINE * (k + 1), person_color(person.number))
    return np.asarray(image, np.uint8)
