"""`tk evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tk.commands import base
from tk.errors import CaptureError

if TYPE_CHECKING:
    from tk.evaluation.joints import Evaluation
    from tk.evaluation.people import PeopleEvaluation


@click.command(epilog=base.example("tk evaluate result.h5 CAPTURE/truth.h5"))
@click.argument("result", type=base.PATH)
@click.argument("truth", type=base.PATH)
@click.option(
    "--capture", type=base.PATH, metavar="DIR",
    help="Also compare in the images: pixels and silhouettes.  [default: the folder of TRUTH, if it is a capture]",
)  # fmt: skip
@base.names_option("--joints", show_default="both ankles", help="Joints to compare in pixels.")
@base.masks_option
@base.json_option
def evaluate(result: Path, truth: Path, capture: Path | None, joints: base.Names, masks: str, as_json: bool) -> None:
    """Compare RESULT with TRUTH: joint distances, PCK, lost frames, frames/s; pixels and silhouettes by view.

    If a file has several people: misses, false positives, identity switches, MOTA, IDF1, and errors by person.
    """
    views = None
    notes = []
    with base.working(f"comparing {result} with {truth}"):
        from tk.evaluation.joints import evaluate as evaluate_one
        from tk.evaluation.people import evaluate_people
        from tk.evaluation.views import capture_of, evaluate_views
        from tk.io.results.reader import read_people, read_truth
        from tk.model.body.joints import ANKLE_JOINTS

        people, true = read_people(result), read_truth(truth)
        several = len(people) > 1 or len(true) > 1
        found: Evaluation | PeopleEvaluation = (
            evaluate_people(people, true) if several else evaluate_one(people[0], true[0])
        )
        folder = capture or capture_of(truth)
        if several and folder:
            notes.append("no comparison in the images: a file has several people")
            folder = None
        try:
            views = evaluate_views(result, truth, folder, joints or ANKLE_JOINTS, masks) if folder else None
        except CaptureError as error:
            if capture is not None:
                raise
            notes.append(f"no comparison in the images: {error}")
    base.print_lines("note: ", notes)
    if as_json:
        base.print_json(**found.to_dict(), **({"views": views.to_dict()} if views else {}))
    else:
        click.echo(found.format_table() + (f"\n\n{views.format_table()}" if views else ""))
