"""Section 7.4: how much the joints turn between frames against the error."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scripts.paper.common import Options, Track, over_seeds, plt, save, table
from tk.settings import Settings

BINS_DEG = (0.0, 5.0, 10.0, 20.0, 30.0, np.inf)


def turned_deg(track: Track) -> np.ndarray:
    """(F - 1,) greatest change of an angle from frame to frame, degrees."""
    angles = np.array([unit == "rad" for unit in track.pose_units])
    step = np.diff(track.pose[:, angles], axis=0)
    return np.degrees(np.abs((step + np.pi) % (2 * np.pi) - np.pi)).max(axis=1)


def run(options: Options) -> str:
    """Write the figure and give the table."""
    tracks = over_seeds(options, Settings())
    turned = np.concatenate([turned_deg(t) for t in tracks])
    error = np.concatenate([t.frame_cm[1:] for t in tracks])
    rows = []
    for low, high in pairwise(BINS_DEG):
        mine = (turned >= low) & (turned < high)
        if mine.any():
            upper = "" if np.isinf(high) else f" to {high:g}"
            rows.append(
                {
                    "greatest change of an angle [°]": f"from {low:g}{upper}",
                    "frames": str(int(mine.sum())),
                    "mean joint error [cm]": f"{error[mine].mean():.2f}",
                    "frames > 10 cm": str(int((error[mine] > 10).sum())),
                }
            )
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
    left.scatter(turned, error, s=6)
    left.set(xlabel="greatest change of an angle [°]", ylabel="mean joint error [cm]", title=options.capture.name)
    right.plot(turned_deg(tracks[0]), label="greatest change [°]", linewidth=1)
    right.plot(tracks[0].frame_cm, label="error [cm]", linewidth=1)
    right.set(xlabel="frame")
    right.legend(fontsize=7)
    save(figure, options.figure)
    return table(rows)
