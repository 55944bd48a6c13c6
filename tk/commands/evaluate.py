"""`tk evaluate`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base
from tk.errors import CaptureError
from tk.model.body.joints import ANKLE_JOINTS


@click.command(epilog=base.example("tk evaluate result.h5 CAPTURE/truth.h5"))
@click.argument("result", type=base.PATH)
@click.argument("truth", type=base.PATH)
@click.option(
    "--capture", type=base.PATH, metavar="DIR",
    help="Also compare in the images: pixels and silhouettes.  [default: the folder of TRUTH, if it is a capture]",
)  # fmt: skip
@click.option("--joints", default=",".join(ANKLE_JOINTS), show_default=True, help="Joints to compare in pixels.")
@base.masks_option
@base.json_option
def evaluate(result: Path, truth: Path, capture: Path | None, joints: str, masks: str, as_json: bool) -> None:
    """Compare RESULT with TRUTH: joint distances, PCK, lost frames, frames/s; pixels and silhouettes by view."""
    views = None
    notes = []
    with base.working(f"comparing {result} with {truth}"):
        from tk.evaluation.joints import evaluate_files
        from tk.evaluation.views import capture_of, evaluate_views

        found = evaluate_files(result, truth)
        folder = capture or capture_of(truth)
        try:
            views = evaluate_views(result, truth, folder, base.split_names(joints) or (), masks) if folder else None
        except CaptureError as error:
            if capture is not None:
                raise
            notes.append(f"no comparison in the images: {error}")
    base.print_notes(notes)
    if as_json:
        base.print_json(**found.to_dict(), **({"views": views.to_dict()} if views else {}))
    else:
        click.echo(found.format_table() + (f"\n\n{views.format_table()}" if views else ""))
