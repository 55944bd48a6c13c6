"""One person who looks like several, or stands elsewhere, because a camera is turned or upside down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import PERSON
from tk.model.cameras.camera import Rig
from tk.model.people import LocatedPerson, PeopleFinder
from tk.model.setup import Setup
from tk.trackers.camera_monitor import image_faults, opening_agreement
from tk.trackers.protocol import Frame, without_cameras

# A camera shows a person if its mask covers this share of the person's hull from the other cameras. Right cameras of
# the demo cover 0.84 and more: the hull is larger than the person. One that is upside down covers 0.19.
_SHOWN = 0.5


def really_there(
    finder: PeopleFinder, setup: Setup, opening: Sequence[Frame], found: tuple[LocatedPerson, ...]
) -> tuple[LocatedPerson, ...]:
    """Return the people in the first frame of an opening: those just ``found`` in all cameras, or one.

    It is one if the cameras without those that contradict them show one, whom the contradicting ones do not show. A
    camera that alone sees a second person shows the first one, too.
    """
    if len(found) == 1 and finder.explain(opening[0].masks, found):
        return found
    agreement = opening_agreement(setup, opening, image_faults(opening))
    if agreement.refusal or not agreement.wrong:
        return found
    wrong = np.isin(np.arange(len(setup.rig)), agreement.wrong)
    frame = without_cameras(opening[0], wrong)
    people = finder.find(frame.masks, frame.uncertain)
    if len(people) == 1 and (_covered(setup.rig, opening[0].masks, people[0])[wrong] < _SHOWN).all():
        return people
    return found


def _covered(rig: Rig, masks: NDArray[np.uint8], person: LocatedPerson) -> NDArray[np.float64]:
    """Return (C,) the share of a person's points that the masks (C, H, W) cover; 1 if a camera sees none."""
    shares = np.ones(len(rig))
    for c, camera in enumerate(rig):
        pixels, depth = camera.project(person.points)
        inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        if inside.any():
            x, y = pixels[inside].astype(int).T
            shares[c] = np.mean(masks[c, y, x] >= PERSON)
    return shares
