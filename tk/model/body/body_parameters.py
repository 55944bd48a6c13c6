"""The bodies about a given one: dimensions and shapes as in :mod:`tk.model.body.body_fit`, as unknowns beside
cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cones import CONE
from tk.model.body.body_fit import BodyProblem as Problem
from tk.model.body.body_fit import shape_rows
from tk.model.body.cone_body import SHAPE_NUMBERS, ConeBody, ConePart, build_cone_body, group_of
from tk.model.cameras.bundle import Seen

Float = NDArray[np.float64]

# Of the logarithm of the stature about that of the given body: the cameras know the scale better.
STATURE_DEVIATION = 0.03


class Family:
    """The bodies about a given one: its dimensions and shapes may change, as in :mod:`tk.model.body.body_fit`."""

    def __init__(self, body: ConeBody) -> None:
        self._problem = Problem(body.preset, body.dimensions, STATURE_DEVIATION)
        self.start: Float = self._problem.mean.copy()
        self.start[-SHAPE_NUMBERS * len(self._problem.groups) :] = shapes_of(body).ravel()

    def build(self, shared: Float) -> ConeBody:
        return self._problem.build(shared)

    def add_prior(self, shared: Float, H: Float, g: Float) -> None:
        self._problem.add_prior(shared, H, g)

    def rows(self, shared: Float, seen: Sequence[Seen]) -> list[Float]:
        """For each of ``seen`` (N, K) the contours' derivatives along their normals by the body's numbers."""
        body = self.build(shared)
        poses = np.array([view.pose for view in seen])
        by_dimension = self._problem.dimension_rows(shared, poses, [view.edgels for view in seen])
        transforms = body.skeleton.segment_transforms(poses)
        return [
            np.hstack([rows, shape_rows(body, T, view.edgels)])
            for rows, T, view in zip(by_dimension, transforms, seen, strict=True)
        ]


def shapes_of(body: ConeBody) -> Float:
    """(G, 8) what :meth:`ConeBody.reshaped` did to the body that its dimensions describe; zero where that is laid out
    in other parts."""
    average = {part.name: part for part in build_cone_body(body.dimensions, preset=body.preset).parts}
    result = np.zeros((len(body.shape_groups), SHAPE_NUMBERS))
    for g, group in enumerate(body.shape_groups):
        # the right side is the left's mirror image
        part = next(part for part in body.parts if group_of(part.name) == group and not part.name.endswith("_r"))
        if part.name in average and average[part.name].kind == part.kind:
            result[g] = _change(average[part.name], part)
    return result


def _change(average: ConePart, part: ConePart) -> Float:
    (a, b, h, m), (a1, b1, h1, m1) = average.shape, part.shape
    T = np.linalg.inv(average.T_body_part) @ part.T_body_part
    slope = T[:2, 2] / T[2, 2]
    if part.kind == CONE:
        begin, end = T[:2, 3], T[:2, 3] + h * slope
    else:
        begin, end = T[:2, 3] - h * slope, T[:2, 3] + h * slope
    return np.concatenate([np.log([a1 / a, b1 / b, m1 / m, h1 / h]), begin, end])
