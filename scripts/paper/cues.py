"""Section 7.2: the surface alone against surface and edges, arms close to the body."""

from __future__ import annotations

from scripts.paper.common import Options, over_seeds, plt, save, spread, table, terms
from tk.settings import Settings


def variants() -> dict[str, Settings]:
    """The cues by name."""
    default = Settings()
    without = terms(default, coverage_weight=0.0)
    return {
        "surface": terms(without, edge_weight=0.0),
        "surface, colour edges": without,
        "surface, coverage": terms(default, edge_weight=0.0),
        "surface, coverage, colour edges": default,
    }


def run(options: Options) -> str:
    """Write the figure and give the table."""
    figure, axes = plt.subplots(figsize=(9, 4))
    rows = []
    for name, config in variants().items():
        tracks = over_seeds(options, config)
        rows.append(
            {
                "cues": name,
                "15 joints: mean [cm]": spread([t.mean_cm for t in tracks]),
                "elbows, wrists [cm]": spread([t.arms_cm for t in tracks]),
                "frames > 10 cm": spread([t.lost_frames for t in tracks], 0),
                "optimisation [ms]": spread([float(sorted(t.optimise_ms)[len(t.optimise_ms) // 2]) for t in tracks], 0),
            }
        )
        axes.plot(tracks[0].frame_cm, label=name, linewidth=1)
    axes.set(xlabel="frame", ylabel="mean joint error [cm]", title=options.capture.name, ylim=(0, 25))
    axes.legend(fontsize=7)
    save(figure, options.figure)
    return table(rows)
