"""Section 7.5: an object in the hand, 64³ against 128³ voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scripts.paper.common import Options, over_seeds, plt, save, spread, table
from tk.settings import Settings


def run(options: Options) -> str:
    """Write the figure and give the table."""
    figure, axes = plt.subplots(figsize=(9, 4))
    rows = []
    for voxels in (64, 128):
        tracks = over_seeds(options, replace(Settings(), voxels=voxels))
        rows.append(
            {
                "voxels": f"{voxels}³",
                "15 joints: mean [cm]": spread([t.mean_cm for t in tracks]),
                "elbows, wrists [cm]": spread([t.arms_cm for t in tracks]),
                "frames > 10 cm": spread([t.lost_frames for t in tracks], 0),
                "optimisation [ms]": spread([float(np.median(t.optimise_ms)) for t in tracks], 0),
            }
        )
        axes.plot(tracks[0].frame_cm, label=rows[-1]["voxels"], linewidth=1)
    axes.set(xlabel="frame", ylabel="mean joint error [cm]", title=options.capture.name)
    axes.legend(fontsize=7)
    save(figure, options.figure)
    return table(rows)
