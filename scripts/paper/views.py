"""Accuracy with the numbers of views of table 1; its times are measured by ``scripts.bench --growth``."""

from __future__ import annotations

from scripts.paper.common import Options, over_seeds, plt, save, spread, table
from tk.io.captures.capture import open_capture
from tk.settings import Settings

VIEWS = (4, 5, 9)


def run(options: Options) -> str:
    """Write the figure and give the table."""
    names = open_capture(options.capture).rig.names
    figure, axes = plt.subplots(figsize=(9, 4))
    rows = []
    for count in VIEWS:
        # evenly spread over the rig's order, which goes around the room
        wanted = min(count, len(names))
        chosen = [names[i * len(names) // wanted] for i in range(wanted)]
        tracks = over_seeds(options, Settings(), cameras=chosen)
        rows.append(
            {
                "views": str(len(chosen)),
                "cameras": ", ".join(chosen),
                "15 joints: mean [cm]": spread([t.mean_cm for t in tracks]),
                "elbows, wrists [cm]": spread([t.arms_cm for t in tracks]),
                "frames > 10 cm": spread([t.lost_frames for t in tracks], 0),
            }
        )
        axes.plot(tracks[0].frame_cm, label=f"{len(chosen)} views", linewidth=1)
    axes.set(xlabel="frame", ylabel="mean joint error [cm]", title=options.capture.name)
    axes.legend(fontsize=7)
    save(figure, options.figure)
    return table(rows)
