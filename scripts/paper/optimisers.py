"""Section 7.3: SMD against Levenberg-Marquardt, at the same and at five times as many points."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np

from scripts.paper.common import Options, over_seeds, plt, save, spread, table
from scripts.paper.levenberg_marquardt import instead_of_smd
from tk.settings import Settings

VARIANTS = (
    ("SMD, 1× points", nullcontext, 1),
    ("SMD, 5× points", nullcontext, 5),
    ("LM, 1× points", instead_of_smd, 1),
    ("LM, 5× points", instead_of_smd, 5),
)


def run(options: Options) -> str:
    """Write the figure and give the table."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 6), sharex=True)
    rows = []
    base = Settings()
    for name, optimiser, scale in VARIANTS:
        config = replace(base, effort=float(scale))
        with optimiser():
            tracks = over_seeds(options, config)
        rows.append(
            {
                "optimiser": name,
                "15 joints: mean [cm]": spread([t.mean_cm for t in tracks]),
                "frames > 10 cm": spread([t.lost_frames for t in tracks], 0),
                "median [ms]": spread([float(np.median(t.optimise_ms)) for t in tracks], 0),
                "90th percentile [ms]": spread([float(np.quantile(t.optimise_ms, 0.9)) for t in tracks], 0),
                "iterations of a descent": spread([float(t.iterations.mean()) for t in tracks], 1),
            }
        )
        above.plot(tracks[0].optimise_ms, label=rows[-1]["optimiser"], linewidth=1)
        below.plot(tracks[0].frame_cm, linewidth=1)
    above.set(ylabel="optimisation [ms]", yscale="log", title=options.capture.name)
    above.legend(fontsize=7)
    below.set(xlabel="frame", ylabel="mean joint error [cm]", ylim=(0, 20))
    save(figure, options.figure)
    return table(rows)
