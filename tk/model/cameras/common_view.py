"""Infers the working volume: the region that the cameras of a rig have in common."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tk.errors import VolumeError
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume

Float = NDArray[np.float64]

#: samples along each side of a box for a test of visibility: 10 cm apart in a box of 2.4 m
_SAMPLES = 24

#: least :func:`depth_information` of usable cameras: an error of 1.5 cm in every view (the mean error of a joint on the
#: development captures) must not exceed 5 cm along any direction. Two cameras reach it at 25° to 155° to each other.
LEAST_INFORMATION = (0.015 / 0.05) ** 2


def views_of(rig: Rig, p_world: Float) -> NDArray[np.int64]:
    """Return (N,) the number of cameras that see each of the points (N, 3)."""
    return np.sum([camera.sees(p_world) for camera in rig], axis=0)


def sample_box(volume: Volume, samples: int = _SAMPLES) -> Float:
    """Return (samples³, 3) points on a regular grid over the box and its faces, metres."""
    axes = [np.linspace(low, high, samples) for low, high in zip(volume.lower, volume.upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def closest_to_axes(rig: Rig) -> Float:
    """Return the point (3,) with the least sum of squared distances to the cameras' optical axes, metres.

    Raises:
        VolumeError: the axes are parallel.
    """
    point = closest_to_lines(rig.centers, np.array([camera.rotation[2] for camera in rig]))
    if point is None:
        raise VolumeError("the cameras' axes are parallel")
    return point


def all_look_away(rig: Rig) -> str | None:
    """Return what is wrong if every camera looks away from the point closest to all optical axes; None otherwise."""
    try:
        middle = closest_to_axes(rig)
    except VolumeError:
        return None
    if any(camera.to_camera(middle)[0, 2] > 0 for camera in rig):
        return None
    return (
        f"all {len(rig)} cameras look away from the point where their axes meet; are their rotations in OpenGL's axes "
        "(y up, z backwards)? They must be in OpenCV's: x right, y down, z forward"
    )


def closest_to_lines(origins: Float, directions: Float) -> Float | None:
    """Return the point (3,) with the least sum of squared distances to lines; None if they are parallel.

    Args:
        origins: (N, 3) a point of each line.
        directions: (N, 3) unit vectors.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # projects onto the plane across each line
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e6:  # parallel within about a milliradian
        return None
    return np.linalg.solve(normal, np.einsum("cij,cj->i", across, origins))


def depth_information(directions: Float, used: NDArray[np.bool_] | None = None) -> Float:
    """Return (...) how well rays determine a point along the direction that they determine worst.

    An error of s metres across every ray gives an error of s / √information metres along that direction. Two rays at an
    angle α have 1 − |cos α|.

    Args:
        directions: (..., N, 3) unit vectors; with some that are not finite, nothing is known.
        used: (..., N) which of them count; None: all.
    """
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]  # what a ray determines
    total = across.sum(axis=-3) if used is None else (across * used[..., None, None]).sum(axis=-3)
    return np.asarray(np.linalg.eigvalsh(np.where(np.isfinite(total), total, 0.0))[..., 0])


def determine_depth(centers: Float, points: Float, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (...) whether the cameras used have at least :data:`LEAST_INFORMATION` about points.

    Args:
        centers: (C, 3) of the cameras.
        points: (..., 3); of one that is not finite nothing is known.
        used: (..., C).
    """
    rays = points[..., None, :] - centers
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.asarray(depth_information(rays, used) >= LEAST_INFORMATION)


def view_height(rig: Rig) -> float:
    """Return the height of the cameras' views at the point closest to their axes, the median, in the rig's unit.

    Raises:
        VolumeError: the axes are parallel.
    """
    distances = np.linalg.norm(rig.centers - closest_to_axes(rig), axis=1)
    return float(np.median([d * c.height / c.matrix[1, 1] for d, c in zip(distances, rig, strict=True)]))


def infer_volume(rig: Rig) -> Volume:
    """Infer a working volume for a rig: the box around the region that all cameras see.

    Start at the point closest to all optical axes. Within 0.6 of its distance to the nearest camera, take the points
    that every camera sees. The volume is their axis-aligned bounding box: a volume that is too large costs time,
    one that is too small cuts the person. The paper (section 4.1) takes the volume as given.

    Raises:
        VolumeError: the axes are parallel, or no region is seen by all cameras.
    """
    for views, volume in common_boxes(rig):
        if views == len(rig):
            return volume
    raise VolumeError("no region is seen by all cameras")


def common_boxes(rig: Rig) -> Iterator[tuple[int, Volume]]:
    """Yield the box that all cameras see, then the box that all but one see, and so on down to two cameras.

    The rule is that of :func:`infer_volume`.

    Yields:
        The number of cameras and the box; numbers without a region are skipped.

    Raises:
        VolumeError: the axes are parallel, or a camera stands where the axes meet.
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
