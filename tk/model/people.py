"""Find all people in a frame set: components of a coarse visual hull that together explain the masks.

Candidates are the connected components of the hull of all masks. Where they leave much of some masks unexplained, the
components of these masks' hull are candidates, too: furniture may hide a person in the other cameras. A component with
several upright columns is split into people. Where silhouettes of different people meet, the hull also contains
ghosts: places where nobody is, although every mask shows somebody there. The people are the smallest set of candidates
that explains the masks: the description length of pixels by people, minimised over all subsets. A ghost explains no
pixel that a person does not.

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
from tk.model.body.plausibility import EXTENT, STATURE_M
from tk.model.body.skeleton import up_rotation
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.coarse import LEAST_LITRES, Voxels, dilated
from tk.model.hull.voxel_table import VoxelTable, components
from tk.model.masks.sightings import BEYOND_M

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Edge of a voxel, metres: a trunk is 0.2 m deep, and a forearm of 0.08 m does not connect two people who shake hands.
_VOXEL_M = 0.06
# Rows of the images that are used, approximately: a voxel has then about two pixels at 4 m.
_ROWS = 240
# Volume of a person's hull, litres, at most: of a man of 125 kg, whose hull may be twice as large. Components smaller
# than a head (4 litres) are ignored.
_MOST_LITRES, _SPECK_LITRES = 250.0, 4.0
# A column of the floor plan is part of a trunk if so many metres of it are in the hull: an arm has 0.1 m, the trunk of
# a crouching adult 0.6 m.
_TRUNK_M = 0.5
# Trunks of two people are at least so far apart, metres: the depth of a chest (0.25 m) and an error of a voxel.
_APART_M = 0.3
# Standard deviation of the smoothed floor plan, metres: half of a trunk's depth.
_SMOOTH_M = 0.1
# Radius of a person's column in a block, metres: half the breadth of the shoulders, and a step.
_BODY_M = 0.35
# Two columns are two people if the floor plan between them falls to this share of the lower one. Half and twice the
# value, and those of the prices of candidates below, change the number of people in one of 40 frames of pair and of a
# rendered embrace at most.
_SADDLE = 0.7
# A person costs as much as this area of unexplained pixels, sum over the views, m²: half the silhouette of an adult in
# one view. A ghost explains less than 0.1, a person half hidden in four views explains 1.
_LEAST_AREA_M2 = 0.3
# By which the extent of a hull exceeds the height, metres: soles, hair, and what is carved too little below the feet.
# Mean of eight people of the development captures; after it, heights are wrong by 0.06 at most.
_EXCESS_M = 0.02
# People whose feet differ in height by less than this share a floor, metres: jumps are as high.
_ONE_FLOOR_M = 0.3
# Two people in one component have at least this share of the volume that they had apart: more than one of two equals.
_TOGETHER = 0.75
# Least pixels of a silhouette of a person whom one camera shows, in the reduced image: 20 rows of 5 pixels.
_LEAST_PIXELS = 100
# Such a person stands at most so far from the volume, metres: farther feet are not on the floor, but hidden.
_FAR_M = 4.0
# Cosine of the angle from up above which a camera looks down so steeply that the lowest pixel need not show the feet.
_STEEP = 0.7
# Weight of pixels that a candidate covers beside the masks: furniture may hide a person in several cameras, and the
# candidate's silhouette is up to twice as large as the person's.
_CONTRADICTED = 0.25
# Area that the people leave unexplained in a camera before a search for others, m²: a quarter of a person.
_LEFT_M2 = 0.15
# The heights of two people are compared in steps of this, metres: hair, shoes and half a voxel at both ends.
_HEIGHT_STEP_M = 0.1
# Half the width and half the height of the space in which one person is followed, metres; and how far this person may
# move between frames.
_HALF_M, _HALF_HEIGHT_M, _STEP_M = 0.9, 1.1, 0.4
# Most candidates that are compared, by volume: all 2^12 subsets take 10 ms.
_MOST = 12


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
        self._rig, self._volume = rig, volume
        self._to_plan = up_rotation(up).T  # rows: two directions on the floor, and up
        self._step = max(1, round(rig.frame_shape[0] / _ROWS))
        around = _around(volume, self._to_plan[2])
        self._grid = VoxelGrid.cover(around, round(max(around.size) / _VOXEL_M))
        self._table = VoxelTable(rig, self._grid, self._step)
        self._flat: NDArray[np.int64]  # of the voxels below
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
        """
        small = self._reduced(masks)
        unsure = small if uncertain is None else small | self._reduced(uncertain)
        seen = (small, unsure, unsure if hidden is None else unsure | self._reduced(hidden))
        known = [c for c in range(len(self._rig)) if small[c].any()]
        found = self._candidates(seen, known, near)
        chosen = self._explaining(found, small)
        missed = np.flatnonzero(self._unexplained(small, chosen)).tolist()
        if 2 <= len(missed) < len(known):
            # only these cameras show somebody: he or she is hidden in the others, or their masks have a gap
            chosen = self._explaining([*found, *self._candidates(seen, missed, near)], small)
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
        return np.asarray(left.sum(axis=(1, 2)) * self._pixel_m2 > _LEFT_M2)

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
        offset = self._step // 2
        small = masks[:, offset :: self._step, offset :: self._step].reshape(len(masks), -1)
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
        for c, camera in enumerate(self._rig):
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
                    views = np.arange(len(self._rig)) == c
                    share = np.where(views, 1.0, np.nan)
                    found.append(
                        LocatedPerson(position, stature, np.nan, points, self._grid.voxel_m, views, share, False)
                    )
        return found

    def _holds(self, position: Float) -> bool:
        return bool(((self._volume.lower <= position) & (position <= self._volume.upper)).all())

    def _reduced(self, masks: NDArray) -> Bool:
        """Return masks in reduced images (C, h, w)."""
        offset = self._step // 2
        return np.asarray(masks[:, offset :: self._step, offset :: self._step] > 0)

    def _candidates(
        self, seen: tuple[Bool, Bool, Bool], cameras: Sequence[int], near: Sequence[LocatedPerson]
    ) -> list[LocatedPerson]:
        """Return who may be in the cameras' hull; the masks in reduced images (C, h, w), with the uncertain pixels,
        and with the hidden ones, too."""
        self._flat, self._voxels = self._table.near_hull(seen[0], seen[2], cameras)
        inside, unsure, allowed = (self._voxels.inside(masks) & self._voxels.sees for masks in seen)
        parts = self._components(inside, allowed, cameras, near)
        return [self._person(part, inside, unsure) for part in parts]

    def _components(
        self, inside: Bool, allowed: Bool, cameras: Sequence[int], near: Sequence[LocatedPerson]
    ) -> list[NDArray[np.int64]]:
        """Return the voxels of each component of the cameras' hull that may be a person; wide components are split.

        Args:
            inside, allowed: (C, N) whether the mask, or the mask with its uncertain and hidden pixels, shows a voxel.
            cameras: the cameras of the hull; each of its voxels is in two masks or more.
            near: see :meth:`find`.
        """
        hull = (allowed[cameras] | ~self._voxels.sees[cameras]).all(axis=0) & (inside[cameras].sum(axis=0) >= 2)
        dense = np.zeros(self._grid.count, np.bool_)
        dense[self._flat[hull]] = True
        label = components(dense.reshape(self._grid.shape)).reshape(-1)[self._flat]
        order = np.argsort(label, kind="stable")
        sizes = np.bincount(label, minlength=1)
        wholes: list[NDArray[np.int64]] = []
        for whole in np.split(order, np.cumsum(sizes)[:-1])[1:]:
            if len(whole) * self._litres >= _SPECK_LITRES:
                middle = self._trunk(whole)
                # a gap in the masks cuts a person in two; nobody stands above somebody else
                above = [k for k, other in enumerate(wholes) if np.linalg.norm(self._trunk(other) - middle) < _APART_M]
                for k in reversed(above):
                    whole = np.concatenate([wholes.pop(k), whole])
                wholes.append(whole)
        parts = [part for whole in wholes for part in self._split(whole, near)]
        return [column for part in parts for column in self._columns(part) if self._plausible(column)]

    @property
    def _litres(self) -> float:
        return 1000 * self._grid.voxel_m**3

    def _plausible(self, part: NDArray[np.int64]) -> bool:
        """Return whether voxels have a person's volume and extent, lying or standing."""
        extent = float(np.ptp(self._voxels.centers[part] @ self._to_plan.T, axis=0).max()) + self._grid.voxel_m
        litres = len(part) * self._litres
        return litres >= LEAST_LITRES and EXTENT[0] * STATURE_M[0] <= extent <= EXTENT[1] * STATURE_M[1]

    def _plan(self, part: NDArray[np.int64]) -> tuple[Float, NDArray[np.int64], Float]:
        """Return the floor plan of voxels: metres of hull by cell, the cell (M, 2) of each voxel, and the first cell.

        Cells have the voxels' edge.
        """
        across = self._voxels.centers[part] @ self._to_plan[:2].T
        low = across.min(axis=0) - 3 * self._grid.voxel_m
        cell = np.rint((across - low) / self._grid.voxel_m).astype(np.int64)
        plan = np.zeros(cell.max(axis=0) + 4)
        np.add.at(plan, tuple(cell.T), self._grid.voxel_m)
        return plan, cell, low

    def _split(self, part: NDArray[np.int64], near: Sequence[LocatedPerson]) -> list[NDArray[np.int64]]:
        """Return the voxels of each person in a component: each belongs to the nearest upright column.

        Columns are at the maxima of the floor plan, or at the positions of the people ``near``, see :meth:`find`.
        """
        plan, cell, low = self._plan(part)
        seeds = self._maxima(plan)
        if len(near) > len(seeds):
            at = [self._to_plan[:2] @ person.position - low for person in near]
            held = [np.linalg.norm(cell * self._grid.voxel_m - place, axis=1).min() < _APART_M for place in at]
            expected = sum(person.volume_m3 for person, holds in zip(near, held, strict=True) if holds)
            if sum(held) > len(seeds) and len(part) * self._litres >= 1000 * _TOGETHER * expected:
                held_at = [place for place, holds in zip(at, held, strict=True) if holds]
                seeds = np.rint(np.array(held_at) / self._grid.voxel_m).astype(np.int64)
        if len(seeds) < 2:
            return [part]
        nearest = np.linalg.norm(cell[:, None] - seeds[None], axis=2).argmin(axis=1)
        return [part[nearest == k] for k in range(len(seeds))]

    def _columns(self, part: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return the voxels about each maximum of the floor plan, if one person cannot have so many; else all.

        Among people who stand close together before few cameras the hull is one block. Which of its columns are people
        is decided by the pixels that they explain.
        """
        if len(part) * self._litres <= _MOST_LITRES:
            return [part]
        plan, cell, _ = self._plan(part)
        seeds = self._maxima(plan, 1.0, self._grid.voxel_m)
        away = np.linalg.norm(cell[:, None] - seeds[None], axis=2) * self._grid.voxel_m
        return [part[near] for near in (away < _BODY_M).T]

    def _trunk(self, part: NDArray[np.int64]) -> Float:
        """Return where the tallest column of voxels stands on the floor plan (2,), metres."""
        plan, _, low = self._plan(part)
        smooth = _blurred(plan, _SMOOTH_M / self._grid.voxel_m)
        return np.array(np.unravel_index(smooth.argmax(), plan.shape)) * self._grid.voxel_m + low

    def _maxima(self, plan: Float, saddle: float = _SADDLE, sigma_m: float = _SMOOTH_M) -> NDArray[np.int64]:
        """Return the cells (K, 2) of the people's trunks in a floor plan smoothed by ``sigma_m``, the tallest first.

        At most :data:`_MOST`. Between two of them the plan falls to the share ``saddle`` of the lower one.
        """
        edge = self._grid.voxel_m
        smooth = _blurred(plan, sigma_m / edge)
        across = 2 * max(1, round(_APART_M / edge)) + 1
        peaks = np.argwhere((smooth == cv2.dilate(smooth, np.ones((across, across)))) & (smooth >= _TRUNK_M))
        peaks = peaks[np.argsort(-smooth[tuple(peaks.T)], kind="stable")]
        kept: list[NDArray[np.int64]] = []
        for peak in peaks:
            height = smooth[tuple(peak)]
            steps = np.linspace(0, 1, 20)[:, None]
            lines = [(peak + steps * (other - peak)).astype(np.float32) for other in kept]
            between = [cv2.remap(smooth, line[:, 1], line[:, 0], cv2.INTER_LINEAR).min() for line in lines]
            if all(lowest <= saddle * height for lowest in between):
                kept.append(peak)
            if len(kept) == _MOST:  # masks that are full everywhere have a maximum in every cell
                break
        return np.array(kept).reshape(-1, 2)

    def _person(self, part: NDArray[np.int64], inside: Bool, unsure: Bool) -> LocatedPerson:
        points, edge = self._voxels.centers[part], self._grid.voxel_m
        sees = self._voxels.sees[:, part]
        # shadows are uncertain, and add to feet and head
        certain = ~(unsure[:, part] & ~inside[:, part]).any(axis=0)
        height = points[certain if certain.any() else slice(None)] @ self._to_plan[2]
        floor, crown = float(height.min()) - edge / 2 + _EXCESS_M, float(height.max()) + edge / 2
        position = np.array([*self._trunk(part), (floor + crown) / 2]) @ self._to_plan
        share = np.full(len(self._rig), np.nan)
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
        best = np.argsort(-gain, kind="stable")[:_MOST]
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
        covered = np.zeros((len(self._rig), *self._voxels.shape), np.bool_)
        for person in people:
            covered |= self._silhouettes(person)
        return covered

    def _silhouettes(self, person: LocatedPerson) -> Bool:
        """Return (C, h, w) the silhouettes of a person in reduced images, rather too large than too small."""
        projected = Voxels.of(self._rig, person.points, person.voxel_m, self._step)
        images = np.zeros((len(self._rig), *projected.shape), np.uint8)
        for image, sees, pixels in zip(images, projected.sees, projected.pixels, strict=True):
            image.ravel()[pixels[sees]] = 1
        return np.array([dilated(image, int(reach)) for image, reach in zip(images, projected.reach, strict=True)])


def _blurred(plan: Float, sigma: float) -> Float:
    """Return a floor plan smoothed by a Gaussian, cells."""
    across = 2 * int(4 * sigma + 0.5) + 1
    return np.asarray(cv2.GaussianBlur(plan, (across, across), sigma, borderType=cv2.BORDER_REFLECT))


def _around(volume: Volume, up: Float) -> Volume:
    """Return the volume, larger on the floor by :data:`BEYOND_M` on all sides and as high as a tall person."""
    grown = np.array(volume.size) + 2 * BEYOND_M * (1 - np.abs(up))
    return replace(volume, size=(float(grown[0]), float(grown[1]), float(grown[2])))
