"""Find all people in a frame set: components of a coarse visual hull that together explain the masks.

Candidates are the connected components of the hull of all masks. Where they leave much of some masks unexplained, the
components of these masks' hull are candidates, too: furniture may hide a person in the other cameras. A component with
several upright columns is split into people, and so is one in which landmarks show several, who embrace. Where
silhouettes of different people meet, the hull also contains ghosts: places where nobody is, although every mask shows
somebody there. The people are the smallest set of candidates that explains the masks: the description length of pixels
by people, minimised over all subsets. A ghost explains no pixel that a person does not.

Sources: hull, Laurentini (1994); ghosts and their removal by occupancy and reprojection, Guan, Franco and Pollefeys,
"Multi-view occlusion reasoning" (2008); choice of a set by description length, Rissanen (1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import PERSON
from tk.model.body.plausibility import STATURE_M
from tk.model.body.skeleton import up_rotation
from tk.model.cameras.camera import Rig
from tk.model.cameras.landmark_agreement import APART_M, consensus, trunk
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.coarse import Voxels, dilated
from tk.model.hull.voxel_table import VoxelTable
from tk.model.masks.sightings import BEYOND_M
from tk.model.reduced_images import every
from tk.people.columns import MOST, HullColumns, Near

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Edge of a voxel, metres: a trunk is 0.2 m deep, and a forearm of 0.08 m does not connect two people who shake hands.
_VOXEL_M = 0.06
# Rows of the images that are used, approximately: a voxel has then about two pixels at 4 m.
_ROWS = 240
# A person costs as much as this area of unexplained pixels, sum over the views, m²: half the silhouette of an adult in
# one view. Half of it, unexplained in a camera, starts a search for others.
_LEAST_AREA_M2 = 0.3
# By which the extent of a hull exceeds the height, metres: soles, hair, and what is carved too little below the feet.
_EXCESS_M = 0.02
# People whose feet differ in height by less than this share a floor, metres: jumps are as high.
_ONE_FLOOR_M = 0.3
# Least pixels of a silhouette of a person whom one camera shows, in the reduced image: 20 rows of 5 pixels.
_LEAST_PIXELS = 100
# Such a person stands at most so far from the volume, metres: farther feet are not on the floor, but hidden.
_FAR_M = 4.0
# Cosine of the angle from up above which a camera looks down so steeply that the lowest pixel need not show the feet.
_STEEP = 0.7
# Weight of pixels that a candidate covers beside the masks: furniture may hide a person in several cameras, and the
# candidate's silhouette is up to twice as large as the person's.
_CONTRADICTED = 0.25
# The heights of two people are compared in steps of this, metres: hair, shoes and half a voxel at both ends.
_HEIGHT_STEP_M = 0.1
# Half the width and half the height of the space in which one person is followed, metres; and how far this person may
# move between frames.
_HALF_M, _HALF_HEIGHT_M, _STEP_M = 0.9, 1.1, 0.4


@dataclass(frozen=True)
class LocatedPerson:
    """A person in one frame set.

    Attributes:
        position: (3,) m, world: centre of the trunk's column, half-way between floor and crown.
        height_m: height, exact to about 5 cm; too large with raised arms, too small for somebody who bends.
        volume_m3: volume of the hull, up to twice the person's with four cameras; NaN if one camera shows the person.
        points: (N, 3) m, centres of the voxels. With one camera: points of the silhouette, upright above the feet.
        voxel_m: edge of a voxel, metres.
        views: (C,) bool, cameras whose masks show the person.
        share: (C,) share of the person's silhouette that the mask covers; NaN for cameras that see nothing of it.
        inside: whether the position is in the working volume.
    """

    position: Float
    height_m: float
    volume_m3: float
    points: Float
    voxel_m: float
    views: Bool
    share: Float
    inside: bool

    @property
    def where(self) -> str:
        """The position in words."""
        return "({:.1f}, {:.1f}, {:.1f}) m".format(*self.position)


def order_people(
    people: Sequence[LocatedPerson], volume: Volume, height_m: float | None = None, position: Float | None = None
) -> tuple[LocatedPerson, ...]:
    """Return the people in the order of their numbers; number 0 is tracked by default.

    People in the working volume come first. Among them the order is: nearest to ``position`` if it is given; then
    closest to ``height_m``, in steps of 10 cm, if it is given; then seen by most cameras; then nearest to the volume's
    centre.

    Args:
        people: the people in the first frame.
        volume: the working volume.
        height_m: the subject's height, metres.
        position: (3,) m, the subject's rough position, world.
    """

    def rank(person: LocatedPerson) -> tuple[float, ...]:
        away = 0.0 if position is None else float(np.linalg.norm(person.position - position))
        misfit = 0 if height_m is None else round(abs(person.height_m - height_m) / _HEIGHT_STEP_M)
        off = float(np.linalg.norm(person.position - np.asarray(volume.center)))
        return not person.inside, away, misfit, -int(person.views.sum()), off

    return tuple(sorted(people, key=rank))


class PeopleFinder:
    """Finds the people in frame sets of one rig.

    Args:
        rig: C cameras.
        volume: the working volume. People are also found around it, where at least two cameras see.
        up: axis that points up.
    """

    def __init__(self, rig: Rig, volume: Volume, up: str) -> None:
        self.rig, self._volume = rig, volume
        self._to_plan = up_rotation(up).T  # rows: two directions on the floor, and up
        self._step = max(1, round(rig.frame_shape[0] / _ROWS))
        around = _around(volume, self._to_plan[2])
        self._grid = VoxelGrid.cover(around, round(max(around.size) / _VOXEL_M))
        self._table = VoxelTable(rig, self._grid, self._step)
        self._voxels: Voxels  # those of the last masks
        middle = np.asarray(volume.center)
        focal = np.array([c.matrix[0, 0] * c.matrix[1, 1] for c in rig])
        # area of a pixel at the middle of the volume, m²
        self._pixel_m2 = (np.linalg.norm(rig.centers - middle, axis=1) * self._step) ** 2 / focal

    def find(
        self,
        masks: NDArray,
        uncertain: Bool | None = None,
        near: Sequence[LocatedPerson] = (),
        hidden: Bool | None = None,
        landmarks: Float | None = None,
    ) -> tuple[LocatedPerson, ...]:
        """Return the people, those in the working volume first, then by volume of their hull, the largest first.

        A person whom only one camera shows is found if the silhouette is whole and touches nobody else's: he or she
        stands where the line of sight of the feet meets the floor, the lower end of the working volume.

        Args:
            masks: (C, H, W), other than 0 where people are.
            uncertain: (C, H, W) bool, pixels that may show a person although their mask is 0.
            hidden: (C, H, W) bool, pixels of known people, who may hide others. Unlike shadows at the feet, they do not
                lower a height.
            near: the people of the last frame. A component that holds the positions of several is split between them
                if it is as large as they were together.
            landmarks: (N, C, L, 4) of N people, see :mod:`tk.model.cues.landmarks`. A component that holds the trunks
                of several is split between them.
        """
        sighted = self._sighted(landmarks)
        places = [(one.position, one.volume_m3) for one in near] if len(near) >= len(sighted) else sighted
        small = self._reduced(masks)
        unsure = small if uncertain is None else small | self._reduced(uncertain)
        seen = (small, unsure, unsure if hidden is None else unsure | self._reduced(hidden))
        known = [c for c in range(len(self.rig)) if small[c].any()]
        found = self._candidates(seen, known, places)
        chosen = self._explaining(found, small)
        missed = np.flatnonzero(self._unexplained(small, chosen)).tolist()
        if 2 <= len(missed) < len(known):
            # only these cameras show somebody: he or she is hidden in the others, or their masks have a gap
            chosen = self._explaining([*found, *self._candidates(seen, missed, places)], small)
        chosen = [*self._on_one_floor(chosen), *self._alone(small, self._covered(chosen))]
        return tuple(sorted(chosen, key=lambda person: (not person.inside, -np.nan_to_num(person.volume_m3))))

    def is_empty(self, masks: NDArray, people: Sequence[LocatedPerson]) -> bool:
        """Return whether nobody stands in the working volume, by the people whom :meth:`find` has just found in masks.

        Cameras that contradict each other have no hull, although somebody is there. So two cameras must show nothing
        that people outside the volume do not explain; with three cameras or less, all but one.
        """
        if any(person.inside for person in people):
            return False
        unexplained = np.count_nonzero(self._unexplained(self._reduced(masks), people))
        return bool(unexplained <= max(1, len(masks) - 2))

    def explain(self, masks: NDArray, people: Sequence[LocatedPerson]) -> bool:
        """Return whether the people whom :meth:`find` has just found in masks leave little of each unexplained."""
        return not self._unexplained(self._reduced(masks), people).any()

    def _unexplained(self, masks: Bool, people: Sequence[LocatedPerson]) -> Bool:
        """Return (C,) whether people leave much of a camera's mask, (C, h, w) reduced, unexplained."""
        left = masks & ~self._covered(people)
        return np.asarray(left.sum(axis=(1, 2)) * self._pixel_m2 > _LEAST_AREA_M2 / 2)

    def around(self, position: Float, masks: NDArray[np.uint8], count: int = 0) -> tuple[Float, Float]:
        """Return the hull of one person who was at a position (3,) a frame ago, and the new position.

        Args:
            position: m, centre of the trunk.
            masks: (C, H, W) 128 or more where the person is, 0 where the person is not, other values where the person
                may be hidden.
            count: number of voxels a frame ago. If less than half of them are left, the mask fails that leaves most
                voxels without it.

        Returns:
            (N, 3) m, centres of the voxels that no mask contradicts and that two masks show; and (3,) m, ``position``
            if there is no trunk near it.
        """
        half = np.abs(self._to_plan.T @ (_HALF_M, _HALF_M, _HALF_HEIGHT_M))
        near = self._grid.within(position - half, position + half)
        small = every(masks, masks.shape[1:], self._step).reshape(len(masks), -1)
        _, voxels = self._table.voxels(near)
        values, sees = np.take_along_axis(small, voxels.pixels, axis=1), voxels.sees
        empty, shown = (values == 0) & sees, ((values >= PERSON) & sees).sum(axis=0) >= 2
        contradictions = empty.sum(axis=0)
        hull = shown & (contradictions == 0)
        if 2 * np.count_nonzero(hull) < count:
            hull = max((shown & (contradictions == one) for one in empty), key=np.count_nonzero)
        moved = (voxels.centers[hull] - position) @ self._to_plan.T
        trunk = moved[np.linalg.norm(moved[:, :2], axis=1) < _STEP_M]
        if len(trunk):
            x, y = np.median(trunk[:, :2], axis=0)
            position = position + [x, y, (trunk[:, 2].min() + trunk[:, 2].max()) / 2] @ self._to_plan
        return voxels.centers[hull], np.asarray(position)

    @property
    def voxel_m(self) -> float:
        """Edge of a voxel, metres."""
        return self._grid.voxel_m

    def _on_one_floor(self, people: Sequence[LocatedPerson]) -> list[LocatedPerson]:
        """Return people with their heights measured from their median floor, which is known better than each one's."""
        up, half = self._to_plan[2], np.array([person.height_m / 2 for person in people])
        middle = np.array([person.position @ up for person in people])
        floor = np.median(middle - half) if len(people) else 0.0
        levelled = []
        for person, own, crown in zip(people, middle - half, middle + half, strict=True):
            if abs(own - floor) < _ONE_FLOOR_M:
                position = person.position + (floor - own) / 2 * up
                person = replace(person, position=position, height_m=float(crown - floor))
            levelled.append(person)
        return levelled

    def _alone(self, masks: Bool, covered: Bool) -> list[LocatedPerson]:
        """Return the people whom one camera shows: parts of masks (C, h, w) that nobody's voxels touch."""
        up = self._to_plan[2]
        corners = np.array([self._volume.lower, self._volume.upper])
        floor, near = float((corners @ up).min()), corners + np.array([[-_FAR_M], [_FAR_M]])
        found = []
        for c, camera in enumerate(self.rig):
            if abs(camera.rotation[2] @ up) > _STEEP:
                continue
            count, regions, stats, _ = cv2.connectedComponentsWithStats(masks[c].astype(np.uint8))
            height, width = masks[c].shape
            for k in range(1, count):
                left, top, across, down = stats[k, :4].tolist()
                cut = top == 0 or left == 0 or left + across >= width or top + down >= height
                y, x = np.nonzero(regions == k)
                if cut or len(y) < _LEAST_PIXELS or covered[c][y, x].any():
                    continue
                rays = camera.rays(np.column_stack([x, y]) * self._step + self._step // 2)
                lowest = rays[y == y.max()].mean(axis=0)
                with np.errstate(divide="ignore"):
                    feet = camera.center + (floor - camera.center @ up) / (lowest @ up) * lowest
                level = (feet - camera.center) - ((feet - camera.center) @ up) * up
                # the silhouette stands in the plane through the feet that faces the camera
                points = camera.center + rays * (level @ level / (rays @ level))[:, None]
                stature = float(np.ptp(points @ up))
                position = feet + stature / 2 * up
                if self._holds(position) or not ((near[0] <= feet) & (feet <= near[1])).all():
                    continue  # in the volume other cameras would show the person
                if level @ lowest > 0 and STATURE_M[0] <= stature <= STATURE_M[1]:
                    views = np.arange(len(self.rig)) == c
                    share = np.where(views, 1.0, np.nan)
                    found.append(
                        LocatedPerson(position, stature, np.nan, points, self._grid.voxel_m, views, share, False)
                    )
        return found

    def _holds(self, position: Float) -> bool:
        return bool(((self._volume.lower <= position) & (position <= self._volume.upper)).all())

    def _reduced(self, masks: NDArray) -> Bool:
        """Return masks in reduced images (C, h, w)."""
        return np.asarray(every(masks, masks.shape[1:], self._step) > 0)

    def _sighted(self, landmarks: Float | None) -> list[tuple[Float, float]]:
        """Return the trunks (3,) of the people on whose landmarks, of (N, C, L, 4), two images agree, metres, with no
        volume: how large their hulls are is unknown."""
        places: list[tuple[Float, float]] = []
        for seen in () if landmarks is None else landmarks:
            place = trunk(consensus(self.rig, seen).points)
            if np.isfinite(place).all() and all(np.linalg.norm(place - p) >= APART_M for p, _ in places):
                places.append((place, 0.0))
        return places

    def _candidates(self, seen: tuple[Bool, Bool, Bool], cameras: Sequence[int], near: Near) -> list[LocatedPerson]:
        """Return who may be in the cameras' hull; the masks in reduced images (C, h, w), with the uncertain pixels,
        and with the hidden ones, too. ``near``: see :class:`~tk.people.columns.HullColumns`."""
        flat, self._voxels = self._table.near_hull(seen[0], seen[2], cameras)
        inside, unsure, allowed = (self._voxels.inside(masks) & self._voxels.sees for masks in seen)
        # each voxel of the hull is in two masks or more
        hull = (allowed[cameras] | ~self._voxels.sees[cameras]).all(axis=0) & (inside[cameras].sum(axis=0) >= 2)
        columns = HullColumns(self._grid, self._to_plan, self._voxels.centers, flat)
        parts = columns.people(hull, near)
        return [self._person(part, columns.trunk(part), inside, unsure) for part in parts]

    def _person(self, part: NDArray[np.int64], trunk: Float, inside: Bool, unsure: Bool) -> LocatedPerson:
        points, edge = self._voxels.centers[part], self._grid.voxel_m
        sees = self._voxels.sees[:, part]
        # shadows are uncertain, and add to feet and head
        certain = ~(unsure[:, part] & ~inside[:, part]).any(axis=0)
        height = points[certain if certain.any() else slice(None)] @ self._to_plan[2]
        floor, crown = float(height.min()) - edge / 2 + _EXCESS_M, float(height.max()) + edge / 2
        position = np.array([*trunk, (floor + crown) / 2]) @ self._to_plan
        share = np.full(len(self.rig), np.nan)
        np.divide(inside[:, part].sum(axis=1), sees.sum(axis=1), out=share, where=sees.any(axis=1))
        return LocatedPerson(
            position,
            crown - floor,
            len(part) * edge**3,
            points,
            edge,
            np.nan_to_num(share) >= 0.5,
            share,
            self._holds(position),
        )

    def _explaining(self, found: Sequence[LocatedPerson], masks: Bool) -> list[LocatedPerson]:
        """Return the subset of candidates with the least area of unexplained pixels and the least people.

        A candidate costs the area of its silhouettes that masks contradict, too.
        """
        if not found:
            return []
        covers = np.array([self._silhouettes(person) for person in found])
        share = np.nan_to_num([person.share for person in found], nan=1.0)
        contradicted = ((1 - share) * covers.sum(axis=(2, 3))) @ self._pixel_m2
        price = _CONTRADICTED * contradicted + _LEAST_AREA_M2
        gain = (covers & masks).sum(axis=(2, 3)) @ self._pixel_m2 - price
        best = np.argsort(-gain, kind="stable")[:MOST]
        best = best[gain[best] > 0]
        # pixels that the same candidates cover count together
        code = np.tensordot(1 << np.arange(len(best)), covers[best].astype(np.int64), 1)
        values, which = np.unique(code[masks], return_inverse=True)
        area = np.broadcast_to(self._pixel_m2[:, None, None], masks.shape)[masks]
        weights = np.bincount(which, area, len(values))
        subsets = np.arange(1 << len(best))
        unexplained = ((subsets[:, None] & values) == 0) @ weights
        cost = unexplained + ((subsets[:, None] >> np.arange(len(best))) & 1) @ price[best]
        return [found[k] for i, k in enumerate(best) if int(cost.argmin()) >> i & 1]

    def _covered(self, people: Sequence[LocatedPerson]) -> Bool:
        """Return (C, h, w) the pixels of reduced images that people cover."""
        covered = np.zeros((len(self.rig), *self._voxels.shape), np.bool_)
        for person in people:
            covered |= self._silhouettes(person)
        return covered

    def _silhouettes(self, person: LocatedPerson) -> Bool:
        """Return (C, h, w) the silhouettes of a person in reduced images, rather too large than too small."""
        projected = Voxels.of(self.rig, person.points, person.voxel_m, self._step)
        images = np.zeros((len(self.rig), *projected.shape), np.uint8)
        for image, sees, pixels in zip(images, projected.sees, projected.pixels, strict=True):
            image.ravel()[pixels[sees]] = 1
        return np.array([dilated(image, int(reach)) for image, reach in zip(images, projected.reach, strict=True)])


def _around(volume: Volume, up: Float) -> Volume:
    """Return the volume, larger on the floor by :data:`BEYOND_M` on all sides and as high as a tall person."""
    grown = np.array(volume.size) + 2 * BEYOND_M * (1 - np.abs(up))
    return replace(volume, size=(float(grown[0]), float(grown[1]), float(grown[2])))
