"""The summary of a batch: `summary.csv` for programs, `summary.html` for people."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from tk.batch.jobs import BEGUN, DONE, FAILED, WAITING, Job, Outcome, other_outcomes
from tk.errors import ResultError
from tk.io.paths import replacing


@dataclass(frozen=True)
class Column:
    """A column of numbers."""

    name: str  # name in the CSV
    value: Callable[[Outcome], float | None]  # returns the number of an outcome; None if it is unknown
    # heading, unit: text in the page; a column without a heading is in the CSV only
    heading: str = ""
    unit: str = ""
    pattern: str = ".2f"  # format of the number in the page; a percentage is multiplied by 100


NUMBERS = (
    Column("frames", lambda o: o.frames or None, "frames", "", ".0f"),
    Column("lost", lambda o: o.lost if o.frames else None),
    Column("suspect", lambda o: o.suspect if o.frames else None),
    Column("lost_percent", lambda o: 100 * o.lost / o.present if o.present else None, "lost", "%", ".1f"),
    Column("suspect_percent", lambda o: 100 * o.suspect / o.present if o.present else None, "suspect", "%", ".1f"),
    Column("error_cm", lambda o: o.error_cm, "error", "cm"),
    Column("limbs_cm", lambda o: o.limbs_cm, "limbs", "cm"),
    Column("silhouette_error", lambda o: o.silhouette_error, "E<sub>S</sub>", "%", ".2%"),
    Column("sigma_median_cm", lambda o: o.sigma_cm, "σ", "median, cm"),
    Column("frames_per_second", lambda o: o.frames_per_second, "speed", "frames/s", ".1f"),
    Column("seconds", lambda o: o.seconds if o.state in (DONE, FAILED) else None),
)

#: columns of captures with ground truth
_WITH_TRUTH = ("error_cm", "limbs_cm")

# columns whose numbers are marked unless they are 0
_BAD = ("lost_percent", "suspect_percent")

# seconds between two reloads of the page while the batch runs
_REFRESH_S = 10

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8881; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1.5rem; }
h1 { font-size: 1.35rem; margin: 0; overflow-wrap: anywhere; }
p.muted { margin: .3rem 0 1.2rem; opacity: .75; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: .38rem .7rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; border-bottom-width: 2px; }
th small { display: block; font-weight: 400; opacity: .7; }
td.text, th.text { text-align: left; }
td.notes { white-space: normal; min-width: 16rem; max-width: 30rem; font-size: .86rem; overflow-wrap: anywhere; }
tr:hover td { background: var(--soft); }
.state { display: inline-block; border-radius: .6rem; padding: 0 .55rem; font-size: .86rem; color: #fff; }
.done { background: #2a7d4f; } .lost { background: #a8650b; } .failed { background: #b3332e; }
.waiting, .begun { background: #6b7280; }
td.bad { color: #c2571a; font-weight: 600; }
"""


def write_summary(folder: Path, jobs: Sequence[Job], outcomes: Mapping[str, Outcome]) -> None:
    """Write `summary.csv` and `summary.html`, each atomically, with the captures of earlier runs after ``jobs``."""
    running = any(outcomes[job.name].state in (WAITING, BEGUN) for job in jobs)
    rows = [*((job, outcomes[job.name]) for job in jobs), *other_outcomes(jobs, folder)]
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(("name", "capture", "state", *(column.name for column in NUMBERS), "notes"))
    for job, outcome in rows:
        values = [column.value(outcome) for column in NUMBERS]
        numbers = [f"{v:.4g}" if isinstance(v, float) else v for v in values]
        writer.writerow((job.name, job.capture, _state(outcome), *numbers, _notes(outcome)))
    for name, text in (("summary.csv", table.getvalue()), ("summary.html", _page(folder, rows, running))):
        with replacing(folder / name, ResultError) as part:
            part.write_text(text, encoding="utf-8")


def _state(outcome: Outcome) -> str:
    return "mostly lost" if outcome.mostly_lost else outcome.state


def _notes(outcome: Outcome) -> str:
    return "; ".join(part for part in (outcome.failure, *outcome.notes) if part)


def _page(folder: Path, rows: Sequence[tuple[Job, Outcome]], running: bool) -> str:
    refresh = f'<meta http-equiv="refresh" content="{_REFRESH_S}">' if running else ""
    name = html.escape(folder.resolve().name)
    has_truth = any(outcome.error_cm is not None for _, outcome in rows)
    shown = [column for column in NUMBERS if column.heading and (has_truth or column.name not in _WITH_TRUTH)]
    heads = "".join(f"<th>{column.heading}<small>{column.unit}</small></th>" for column in shown)
    body = "\n".join(_line(job, outcome, shown) for job, outcome in rows)
    return f"""<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">{refresh}
<title>{name}: tk batch</title>
<style>{_STYLE}</style></head>
<body>
<h1>{name}</h1>
<p class="muted">{html.escape(_counts([outcome for _, outcome in rows]))}</p>
<div class="scroll"><table>
<thead><tr><th class="text">capture</th><th class="text">state</th>{heads}<th class="text">notes</th></tr></thead>
<tbody>
{body}
</tbody></table></div>
<p class="muted">Error: mean distance of all joints from the ground truth, raw; limbs: of the limb joints without
constant offsets; lower is better. E<sub>S</sub>: share of wrong pixels, body outside the mask or mask outside the body.
σ: standard deviation of a joint position along one axis. Speed: of the last attempt, with start-up and both passes.</p>
</body></html>
"""


def _counts(outcomes: Sequence[Outcome]) -> str:
    states = [outcome.state for outcome in outcomes]
    counts = [(states.count(state), word) for state, word in ((DONE, "done"), (FAILED, "failed"))]
    counts.append((len(states) - sum(count for count, _ in counts), "waiting"))
    frames = sum(outcome.frames for outcome in outcomes)
    lost = sum(outcome.lost for outcome in outcomes)
    suspect = sum(outcome.suspect for outcome in outcomes)
    parts = [f"{count} {word}" for count, word in counts if count]
    when = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")
    return (
        f"{len(states)} captures: {', '.join(parts)}. {frames} frames, {lost} of them lost, {suspect} suspect. {when}"
    )


def _line(job: Job, outcome: Outcome, columns: Sequence[Column]) -> str:
    title = html.escape(job.name)
    shown = next((path for path in (job.page, job.output) if path.exists()), None)
    if shown is not None:
        title = f'<a href="{quote(shown.name)}">{title}</a>'
    look = "lost" if outcome.mostly_lost else outcome.state
    cells = [
        f'<td class="text" title="{html.escape(str(job.capture))}">{title}</td>',
        f'<td class="text"><span class="state {look}">{_state(outcome)}</span></td>',
    ]
    for column in columns:
        value = column.value(outcome)
        text = "" if value is None else format(value, column.pattern).removesuffix("%")
        cells.append(f"<td{' class=bad' if column.name in _BAD and value else ''}>{text}</td>")
    cells.append(f'<td class="text notes">{html.escape(_notes(outcome))}</td>')
    return f"<tr>{''.join(cells)}</tr>"
