"""The scenes with several people: who they are, where they walk and what they do.

Cameras hang about 3.7 m from the origin, at 38, 128, 221 and 312 degrees in rigs of four and five. Bodies within
1.5 m of the origin are entirely seen by all of them.
"""

from __future__ import annotations

import numpy as np

from scripts.synthetic.actor import Look
from scripts.synthetic.people import READY, Role, Scene

_DARK, _FAIR = (0.16, 0.075, 0.045), (0.62, 0.37, 0.27)
_BLACK, _BROWN, _BLOND, _GREY = (0.02, 0.015, 0.012), (0.12, 0.06, 0.03), (0.32, 0.20, 0.08), (0.14, 0.13, 0.12)
_RED = Look()
_BLUE = Look(_FAIR, _BROWN, (0.06, 0.22, 0.40), (0.16, 0.15, 0.14))
_GREEN = Look(hair=_BLACK, shirt=(0.08, 0.26, 0.07), trousers=(0.22, 0.17, 0.10), stripes=True)
_LIGHT = Look(_DARK, _BLACK, (0.30, 0.30, 0.31), (0.05, 0.05, 0.06))
_NAVY = Look(_FAIR, _BLOND, (0.035, 0.05, 0.10), (0.045, 0.055, 0.08), stripes=True)
_ORANGE = Look(hair=_GREY, shirt=(0.48, 0.17, 0.03), trousers=(0.035, 0.035, 0.04))
_TEAL = Look(_DARK, _BLACK, (0.04, 0.22, 0.21), (0.20, 0.19, 0.17))
_OLIVE = Look(_FAIR, _BROWN, (0.16, 0.15, 0.06), (0.07, 0.09, 0.16))
_WINE = Look(hair=_BLACK, shirt=(0.22, 0.03, 0.07), trousers=(0.28, 0.27, 0.25))


def circle(
    start: float, stop: float, radii: tuple[float, float], turns: float, from_deg: float
) -> list[tuple[float, float, float]]:
    """Return a way around the origin on an ellipse, between two frames; negative turns are clockwise."""
    frame = np.linspace(start, stop, int(stop - start) // 2 + 1)
    angle = np.radians(from_deg) + 2 * np.pi * turns * (frame - start) / (stop - start)
    x, y = radii[0] * np.cos(angle), radii[1] * np.sin(angle)
    return [(float(f), float(a), float(b)) for f, a, b in zip(frame, x, y, strict=True)]


# Two people. The first three scenes are for development, the other three for reports.

_CIRCLING = Scene(
    120,
    (
        Role([(READY, -0.95, 0.0), *circle(31, 122, (1.05, 1.0), 1.3, 180)], look=_RED),
        Role([(READY, 0.70, 0.1), *circle(32, 122, (0.42, 0.42), -2.6, 10)], [(0, 180.0)], stature_m=1.64, look=_BLUE),
    ),
)
_HANDSHAKE = Scene(
    110,
    (
        Role(
            [
                (READY, -0.85, -0.1), (38, -0.40, 0.0), (55, -0.40, 0.0), (63, -0.70, -0.2), (74, 0.20, -0.42),
                (84, 0.95, -0.10), (90, 0.70, 0.35), (100, -0.15, 0.42), (110, -0.9, 0.25),
            ],
            [(0, 0.0), (60, 0.0)],
            [("shake hands", 42, 53)],
            1.82,
            _LIGHT,
        ),
        Role(
            [
                (READY, 0.85, 0.1), (38, 0.39, 0.0), (55, 0.39, 0.0), (63, 0.70, 0.2), (74, -0.20, 0.42),
                (84, -0.95, 0.10), (90, -0.70, -0.35), (100, 0.15, -0.42), (110, 0.9, -0.25),
            ],
            [(0, 180.0), (60, 180.0)],
            [("shake hands", 42, 53)],
            1.70,
            _GREEN,
        ),
    ),
)  # fmt: skip
_EMBRACE = Scene(
    116,
    (
        Role(
            [
                (READY, -0.75, 0.0), (42, -0.195, 0.0), (50, -0.195, 0.0), (61, -0.75, -0.1), (65, -0.75, -0.1),
                (78, -0.195, 0.02), (86, -0.195, 0.02), (95, -0.70, -0.25), (98, -0.70, -0.33), (116, 0.75, -0.33),
            ],
            [(0, 0.0)],
            [("embrace above", 45, 49), ("embrace below", 80, 84)],
            1.78,
            _OLIVE,
            strolling=False,
        ),
        Role(
            [
                (READY, 0.75, 0.1), (42, 0.195, 0.0), (50, 0.195, 0.0), (61, 0.75, 0.1), (65, 0.75, 0.1),
                (78, 0.195, 0.0), (86, 0.195, 0.0), (95, 0.70, 0.25), (98, 0.70, 0.33), (116, -0.75, 0.33),
            ],
            [(0, 180.0)],
            [("embrace below", 45, 49), ("embrace above", 80, 84)],
            1.66,
            _WINE,
            strolling=False,
        ),
    ),
)  # fmt: skip
_SIMILAR = Scene(
    120,
    (
        Role([(READY, -0.7, 0.1), *circle(32, 122, (0.41, 0.44), 2.5, 190)], look=_NAVY, stature_m=1.78),
        Role(
            [(READY, 0.90, -0.1), *circle(31, 122, (1.15, 1.03), -1.25, -10)], [(0, 180.0)], stature_m=1.73, look=_NAVY
        ),
    ),
)
_CROUCHING = Scene(
    112,
    (
        Role(
            [(READY, -0.85, -0.3), (38, -0.47, 0.22), (70, -0.47, 0.22), *circle(78, 114, (1.03, 1.03), -0.5, 155)],
            [(0, 0.0), (40, -20.0), (76, 40.0)],
            [("crouch", 50, 62)],
            1.68,
            _ORANGE,
        ),
        Role(
            [(READY, 0.80, 0.2), (40, 0.13, 0.02), (67, 0.13, 0.02), *circle(75, 114, (0.44, 0.44), 1.15, 0)],
            [(0, 180.0), (42, 170.0), (54, 110.0), (68, 60.0)],
            (),
            1.84,
            _TEAL,
        ),
    ),
)
_ENTERING = Scene(
    118,
    (
        Role([(READY, 0.0, 0.0), *circle(32, 120, (0.43, 0.43), 2.55, 180)], [(0, 90.0)], (), 1.74, _GREEN),
        Role(
            [(0, 0.4, 3.4), (24, 0.25, 2.1), *circle(38, 120, (1.05, 1.05), -1.17, 88)],
            [(0, 265.0)],
            (),
            1.66,
            _ORANGE,
            posed=False,
        ),
    ),
)

# A subject and a bystander.

_SUBJECT = Role([(READY, -0.6, 0.0), *circle(34, 82, (0.60, 0.55), 0.7, 180)], stature_m=1.77, look=_RED)


def _standing(x: float, y: float, degrees: float, look: Look) -> Scene:
    return Scene(80, (_SUBJECT, Role([(0, x, y), (80, x, y)], [(0, degrees)], (), 1.71, look, posed=False)))


def _walking(look: Look, *way: tuple[float, float, float]) -> Scene:
    return Scene(80, (_SUBJECT, Role(way, [(0, 225.0)], (), 1.80, look, posed=False)))


SCENES: dict[str, Scene] = {
    "circling": _CIRCLING,
    "handshake": _HANDSHAKE,
    "embrace": _EMBRACE,
    "similar": _SIMILAR,
    "crouching": _CROUCHING,
    "entering": _ENTERING,
    "bystander-one": _standing(2.2, -1.0, 155.0, _LIGHT),
    "bystander-two": _standing(0.0, 2.3, -90.0, _BLUE),
    "bystander-all": _standing(1.25, 0.25, 190.0, _GREEN),
    "bystander-walking": _walking(_LIGHT, (0, 0.5, 2.6), (80, 0.5, -3.0)),
    "bystander-entering": _walking(_OLIVE, (0, 3.2, 0.3), (30, 3.0, 0.3), (80, -2.0, 0.2)),
}
"""Scenes by name."""
