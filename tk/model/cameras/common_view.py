"""Where the cameras of a rig look together: a working volume when nobody has given one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tk.errors import VolumeError
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume

Float = NDArray[np.float64]

#: samples along each side of a box whose visibility is asked for
_SAMPLES = 24


def views_of(rig: Rig, p_world: Float) -> NDArray[np.int64]:
    """(N,) the number of cameras that have each of the points (N, 3) in their picture."""
    return np.sum([camera.sees(p_world) for camera in rig], axis=0)


def sample_box(volume: Volume, samples: int = _SAMPLES) -> Float:
    """(samples³, 3) points on a regular grid over the box, its faces included, metres."""
    axes = [np.linspace(low, high, samples) for low, high in zip(volume.lower, volume.upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def closest_to_axes(rig: Rig) -> Float:
    """(3,) the point with the least sum of squared distances to the cameras' optical axes, metres.

    Raises:
        VolumeError: the axes are parallel, so that there is no such point.
    """
    point = closest_to_lines(rig.centers, np.array([camera.rotation[2] for camera in rig]))
    if point is None:
        raise VolumeError("the cameras' axes are parallel")
    return point


def closest_to_lines(origins: Float, directions: Float) -> Float | None:
    """(3,) the point with the least sum of squared distances to lines; None where they are parallel.

    Args:
        origins: (N, 3) a point of each.
        directions: (N, 3) unit vectors.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # projects onto the plane across each line
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e6:  # within about a milliradian of one another
        return None
    return np.linalg.solve(normal, np.einsum("cij,cj->i", across, origins))


def infer_volume(rig: Rig) -> Volume:
    """A working volume for a rig: the box around what all cameras see in common.

    The rule: start at the point closest to all optical axes. Around it, out to 0.6 of the distance to the nearest
    camera, take the points that are in every camera's picture. The volume is their axis-aligned bounding box: rather
    too large than a head cut off. The paper (section 4.1) takes the volume as given.

    Raises:
        VolumeError: the axes do not meet, or no region is seen by all cameras.
    """
    for views, volume in common_boxes(rig):
        if views == len(rig):
            return volume
    raise VolumeError("no region is seen by all cameras")


def common_boxes(rig: Rig) -> Iterator[tuple[int, Volume]]:
    """What all cameras see in common, then what all but one of them do, and so on down to two.

    The rule is that of :func:`infer_volume`.

    Yields:
        the number of cameras and the box, the larger the fewer cameras; numbers without a region are left out.

    Raises:
        VolumeError: the axes do not meet, or a camera stands where they do.
    """
    middle = closest_to_axes(rig)
    reach_m = 0.6 * float(np.linalg.norm(rig.centers - middle, axis=1).min())
    if not reach_m > 0:
        raise VolumeError("a camera stands where the others look")
    ball = sample_box(Volume(_triple(middle), (2 * reach_m,) * 3), 2 * _SAMPLES)
    ball = ball[np.linalg.norm(ball - middle, axis=1) <= reach_m]
    seen_by = views_of(rig, ball)
    for views in range(len(rig), 1, -1):
        common = ball[seen_by >= views]
        if len(common) == 0:
            continue
        lower, upper = common.min(axis=0), common.max(axis=0)
        if (upper > lower).all():
            yield views, Volume(_triple((lower + upper) / 2), _triple(upper - lower))


def _triple(values: Float) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
