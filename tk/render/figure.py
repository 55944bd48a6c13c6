"""The geometry of a person in every frame: joints, and the body's solids as meshes in their segments."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.results.data import Result
from tk.io.results.status import has_pose
from tk.model.body.cone_body import ConeBody
from tk.model.body.joints import SEGMENTS
from tk.model.cameras.camera import Camera
from tk.render.palette import LOST_BODY, SEGMENT_COLORS, Color, person_color
from tk.trackers.bodies import body_and_poses

Float = NDArray[np.float64]

#: points around a solid, appearance only
AROUND = 24
# circles along an ellipsoid, appearance only; a frustum has two
_ALONG = 9


@dataclass(frozen=True)
class Solid:
    """A convex solid that moves with a segment."""

    segment: int  # its index in `tk.model.body.skeleton.SEGMENTS`
    rings: Float  # (R, AROUND, 3) circles from one end to the other in the segment's frame, zero configuration; metres

    @cached_property
    def divided(self) -> Solid:
        """The same solid with at least five circles: its faces are short enough to be sorted by depth."""
        if len(self.rings) > 2:
            return self
        share = np.linspace(0, 1, 5)[:, None, None]
        return Solid(self.segment, (1 - share) * self.rings[0] + share * self.rings[1])

    @cached_property
    def mantle(self) -> NDArray[np.int64]:
        """(M, 3) triangles between the circles, indices into the points of all circles; normals point outwards."""
        index = np.arange(len(self.rings) * AROUND).reshape(-1, AROUND)
        following = np.roll(index, -1, axis=1)
        a, b, c, d = (part.ravel() for part in (index[:-1], following[:-1], following[1:], index[1:]))
        return np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """(M, 3) :attr:`mantle` and both flat ends."""
        fan = np.array([[0, k, k + 1] for k in range(1, AROUND - 1)])
        last = (len(self.rings) - 1) * AROUND
        return np.concatenate([self.mantle, fan[:, ::-1], last + fan])


@dataclass(frozen=True)
class Seen:
    """A person in the image of a camera.

    Solids are convex, so the outline of each is the convex hull of its projected circles (lens distortion bends it by
    less than a pixel over a limb). Solids that are partly behind the camera are left out; such joints are NaN.
    """

    joints: Float  # (J, 2) pixels
    points: Float  # (N, 2) pixels, the circles of all solids
    solids: tuple[tuple[str, int, int], ...]  # segment, first point and end of each solid; the farthest segment first


@dataclass(frozen=True)
class Figure:
    """The person in F frames."""

    frames: NDArray[np.int64]  # (F,) source frames
    joints: Float  # (F, J, 3) metres, world frame
    sigma: Float | None  # (F, J) standard deviations of the joints, metres, or None
    status: NDArray[np.uint8]  # (F,) as in the result
    solids: tuple[Solid, ...]  # the body; empty if the result has no body
    transforms: Float  # (F, S, 4, 4) of the segments, zero configuration to world
    person: int = 0  # number in the result
    _placed: dict[int, Float] = field(default_factory=dict, repr=False, compare=False)

    def lost(self, row: int) -> bool:
        """Return whether the frame has no pose: the person is lost or absent."""
        return self._lost[row]

    @cached_property
    def _lost(self) -> list[bool]:
        return [not has for has in has_pose(self.status).tolist()]

    def there(self, row: int) -> bool:
        """Return whether any joint is known in a frame."""
        return bool(np.isfinite(self.joints[row]).any())

    def color(self, row: int, segment: str) -> Color:
        """Return the colour of a segment: each person after the first has one colour; lost people are grey."""
        if self.lost(row):
            return LOST_BODY
        return person_color(self.person) if self.person else SEGMENT_COLORS[segment]

    def placed(self, row: int) -> Float:
        """Return the points (N, 3) of all circles in a frame, solid by solid; metres, world frame."""
        if row not in self._placed:  # the same for all cameras
            self._placed.clear()
            T = self.transforms[row]
            self._placed[row] = np.concatenate(
                [s.rings.reshape(-1, 3) @ T[s.segment, :3, :3].T + T[s.segment, :3, 3] for s in self.solids]
            )
        return self._placed[row]

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(S + 1,) index of the first point of each solid in :meth:`placed`, and the number of points."""
        return np.cumsum([0, *(solid.rings.size // 3 for solid in self.solids)])

    def seen(self, row: int, camera: Camera) -> Seen:
        """Return the person in the image of a camera."""
        joints = self.joints[row]
        if not self.solids or not self.there(row):
            return Seen(camera.project(joints)[0], np.zeros((0, 2)), ())
        xy, depth = camera.project(np.concatenate([self.placed(row), joints]))
        starts, segment = self.starts, self._segment
        xy_joints, xy = xy[starts[-1] :], xy[: starts[-1]]
        middle = np.add.reduceat(depth[: starts[-1]], starts[:-1]) / np.diff(starts)
        whole = np.isfinite(np.add.reduceat(xy[:, 0], starts[:-1]))
        total = np.bincount(segment, np.where(whole, middle, 0), len(SEGMENTS))
        far = total / np.maximum(np.bincount(segment, whole, len(SEGMENTS)), 1)
        order = np.argsort(-far[segment], kind="stable").tolist()  # the solids of a segment stay together
        ends = starts.tolist()
        solids = tuple((SEGMENTS[self.solids[k].segment], ends[k], ends[k + 1]) for k in order if whole[k])
        return Seen(xy_joints, xy, solids)

    @cached_property
    def _segment(self) -> NDArray[np.int64]:
        """(S,) segment of each solid."""
        return np.array([solid.segment for solid in self.solids])


def figure_of(result: Result) -> Figure:
    """Return the person of a result, joints in the order of :data:`~tk.model.body.skeleton.JOINTS`."""
    if not len(result):
        raise ResultError(f"{result.path}: has no frames")
    result = result.in_joint_order()
    restored = body_and_poses(result)
    solids: tuple[Solid, ...] = ()
    transforms = np.zeros((len(result), 0, 4, 4))
    if restored is not None:
        body, poses = restored
        solids, transforms = solids_of(body), body.skeleton.segment_transforms(poses)
    return Figure(result.frames, result.joints, result.sigma, result.status, solids, transforms, result.person)


def solids_of(body: ConeBody) -> tuple[Solid, ...]:
    """Return the solids of a body in the frames of their segments."""
    found = [(*place, _part_rings(body, p)) for p, place in enumerate(zip(*body.frames, strict=True))]
    return tuple(Solid(int(segment), rings @ T[:3, :3].T + T[:3, 3]) for segment, T, rings in found)


def _part_rings(body: ConeBody, p: int) -> Float:
    """Return the circles (R, AROUND, 3) of part p, a frustum or an ellipsoid, in its own frame."""
    around = np.linspace(-np.pi, np.pi, AROUND, endpoint=False)
    angle, z = np.meshgrid(around, np.linspace(0, 1, 2 if body.is_cone[p] else _ALONG))
    radius = np.ones_like(z)
    if not body.is_cone[p]:
        radius, z = np.sin(np.pi * z), -np.cos(np.pi * z)
    unscaled = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    return body.local(np.full(z.size, p), unscaled.reshape(-1, 3)).reshape(unscaled.shape)
