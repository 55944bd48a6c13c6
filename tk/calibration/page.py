"""The verdict as an HTML page with pictures, in one file."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.calibration.bundle import View
from tk.calibration.rig import Calibrated
from tk.calibration.verdict import ERROR_M, LEVELS, RMS_PX, CameraVerdict, Verdict, person_points
from tk.io.paths import Kind, looks_like, replacing

Float = NDArray[np.float64]

_GENERATOR = '<meta name="generator" content="tk calibrate">'
PAGE = Kind("a calibration report of tk", (".html", ".htm"), looks_like(rb".*" + _GENERATOR.encode()))

#: views with the largest errors that are shown
_WORST = 8
#: colours of the verdicts, and of an error from small to large
_COLORS = ("#2f7d4f", "#b27700", "#c0392b")
_STYLE = """
:root { --page: #f4f4f1; --paper: #fff; --ink: #1b1f23; --muted: #5d666f; --line: #dcdcd6; --wire: #7b858f }
@media (prefers-color-scheme: dark) {
  :root { --page: #15181b; --paper: #1e2226; --ink: #e6e8ea; --muted: #98a2ab; --line: #343a40; --wire: #8b95a0 }
}
* { box-sizing: border-box }
body { margin: 0 auto; max-width: 1240px; padding: 20px 24px 40px; background: var(--page); color: var(--ink);
  font: 14px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif; font-variant-numeric: tabular-nums }
h1 { margin: 0 0 4px; font-size: 26px } h2 { margin: 0 0 8px; font-size: 16px }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 8px; padding: 14px 16px;
  margin-top: 16px; overflow-x: auto }
.word { color: #fff; border-radius: 4px; padding: 2px 12px; margin-left: 8px }
.muted, figcaption { color: var(--muted); font-size: 12px }
table { border-collapse: collapse; font-size: 13px } th { text-align: left; color: var(--muted); font-size: 12px;
  border-bottom: 1px solid var(--line) } th, td { padding: 3px 14px 3px 0; white-space: nowrap }
td.n, th.n { text-align: right }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(280px, 1fr)); gap: 14px }
.plans { display: grid; grid-template-columns: 1fr 1fr; gap: 14px }
figure { margin: 0 } svg { display: block; width: 100%; height: auto; border-radius: 4px } svg text { fill: var(--ink) }
ul { margin: 0; padding-left: 18px }
"""


def build_page(done: Calibrated, verdict: Verdict, title: str) -> str:
    """Return the page."""
    reasons = "".join(
        f'<li><b style="color:{_COLORS[level]}">{LEVELS[level]}</b> {html.escape(text)}</li>'
        for level, text in verdict.reasons
    )
    notes = "".join(f"<li>{html.escape(text)}</li>" for text in verdict.notes)
    parts = [
        f'<h1>Calibration <span class="word" style="background:{_COLORS[verdict.level]}">{verdict.word}</span></h1>',
        f'<p class="muted">{html.escape(title)}</p>',
        _section("What it means", f"<p>{html.escape(summary(done, verdict))}</p><ul>{reasons}{notes}</ul>"),
        _section("Cameras", _camera_table(verdict)),
        _section(
            "Where the points are in each image",
            '<p class="muted">Dots are points of the board in all used images, green to red with their error '
            f"(red: {RMS_PX[0]:g} px and more). Distortion is unknown in empty parts. Lines are errors, "
            'enlarged 100 times.</p><div class="grid">'
            + "".join(_coverage(done, c) for c in range(len(done.names)))
            + "</div>",
        ),
        _section("Cameras and boards", _plans(done)),
    ]
    if len(done.names) > 1:
        parts.append(_section("Connections", _pairs(done, verdict)))
    parts.append(_section("Images with the largest errors", f'<div class="grid">{"".join(_worst(done))}</div>'))
    parts.append(_section("What determines the intrinsics", _determined(verdict)))
    body = "\n".join(parts)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">{_GENERATOR}'
        f'<meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def write_page(path: Path, page: str) -> None:
    """Write the page, under a temporary name first."""
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8", errors="replace")


def summary(done: Calibrated, verdict: Verdict) -> str:
    """Return the verdict in two or three sentences."""
    worst = max(verdict.cameras, key=lambda one: one.rms_px)
    text = f"{len(done.names)} cameras, {len(done.world.state.boards)} instants, {done.board.title}. "
    if np.isfinite(verdict.error_m):
        text += (
            f"A point at the person is expected to be off by {1000 * verdict.error_m:.1f} mm "
            f"(good: up to {1000 * ERROR_M[0]:.0f} mm, usable: up to {1000 * ERROR_M[1]:.0f} mm). "
        )
    text += (
        f"The board's points are {worst.rms_px:.2f} px off in the worst camera, {worst.name}: "
        f"{1000 * worst.rms_m:.1f} mm at the person. World: {verdict.world}."
    )
    if verdict.apart_m:
        a, b, apart = verdict.apart_m
        text += f" Check the scale with a tape: cameras {a} and {b} are {apart:.2f} m apart."
    return text


def _section(title: str, content: str) -> str:
    return f"<section><h2>{title}</h2>{content}</section>"


def _row(cells: Iterable[object], tag: str = "td") -> str:
    texts = [str(cell) for cell in cells]
    first = f"<{tag}>{html.escape(texts[0])}</{tag}>"
    return "<tr>" + first + "".join(f'<{tag} class="n">{html.escape(t)}</{tag}>' for t in texts[1:]) + "</tr>"


def _camera_table(verdict: Verdict) -> str:
    head = (
        "camera", "lens", "views", "points", "error, px", "at the person, mm", "focal length, px", "±", "image covered",
        "board at", "height, m", "shared", "contradict",
    )  # fmt: skip
    rows = [
        _row((
            one.name, one.model, one.views, one.points, f"{one.rms_px:.2f}", f"{1000 * one.rms_m:.1f}",
            f"{one.focal_px:.1f}", f"{100 * one.focal_sigma:.2f} %" if one.how != "given" else "given",
            f"{100 * one.covered:.0f} %", f"{one.near_m:.1f}–{one.far_m:.1f} m", f"{height:.2f}", one.shared,
            one.contradicting,
        ))
        for one, height in zip(verdict.cameras, verdict.heights_m, strict=True)
    ]  # fmt: skip
    filled = f"<p>Boards fill {100 * verdict.filled:.0f} % of the space where the person is.</p>"
    return f"<table>{_row(head, 'th')}{''.join(rows)}</table>{filled if np.isfinite(verdict.filled) else ''}"


def _picture(done: Calibrated, c: int, instant: int) -> str:
    """Return a view's small picture as an SVG image of the camera's size."""
    footage = done.footages[c]
    data = base64.b64encode(footage.seen[instant].picture).decode()
    size = f'width="{footage.width}" height="{footage.height}"'
    return f'<image href="data:image/jpeg;base64,{data}" {size} preserveAspectRatio="none"/>'


def _svg(width: float, height: float, content: str) -> str:
    return f'<svg viewBox="0 0 {width:g} {height:g}" xmlns="http://www.w3.org/2000/svg">{content}</svg>'


def _error_color(error_px: float) -> str:
    share = min(error_px / RMS_PX[0], 1.0)
    return f"hsl({120 * (1 - share):.0f} 85% 45%)"


def _marks(done: Calibrated, view: View, radius: float) -> str:
    errors = done.solved.state.errors(view)
    marks = []
    for (x, y), error in zip(view.pixels, errors, strict=True):
        size = float(np.linalg.norm(error))
        color = _error_color(size)
        dx, dy = 100 * error / max(1.0, 100 * size / (20 * radius))
        marks.append(
            f'<path d="M{x:.0f} {y:.0f}l{dx:.0f} {dy:.0f}" stroke="{color}" stroke-width="{radius / 2:g}"/>'
            f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{radius:g}" fill="{color}"/>'
        )
    return "".join(marks)


def _coverage(done: Calibrated, c: int) -> str:
    footage, views = done.footages[c], [view for view in done.views if view.camera == c]
    if not views:
        return ""
    largest = max(views, key=lambda view: float(np.prod(np.ptp(view.pixels, axis=0))))
    radius = max(1.5, footage.width / 260)
    shade = f'<rect width="{footage.width}" height="{footage.height}" fill="#000" opacity="0.35"/>'
    marks = "".join(_marks(done, view, radius) for view in views)
    picture = _svg(footage.width, footage.height, _picture(done, c, largest.instant) + shade + marks)
    return f"<figure><figcaption>{html.escape(footage.name)}: {len(views)} views</figcaption>{picture}</figure>"


def _worst(done: Calibrated) -> Iterable[str]:
    found = sorted((*done.views, *done.dropped), key=lambda view: -_error(done, view))[:_WORST]
    for view in found:
        footage = done.footages[view.camera]
        outline = " ".join(f"{x:.0f},{y:.0f}" for x, y in footage.seen[view.instant].outline)
        left_out = any(view is other for other in done.dropped)
        radius = max(1.5, footage.width / 300)
        frame = f'<polygon points="{outline}" fill="none" stroke="#4aa3ff" stroke-width="{radius:g}"/>'
        marks = "" if left_out else _marks(done, view, radius)
        picture = _svg(footage.width, footage.height, _picture(done, view.camera, view.instant) + frame + marks)
        what = "contradicts the others, not used" if left_out else f"{_error(done, view):.2f} px"
        text = f"{footage.name}, {'frame' if footage.clip is not None else 'picture'} {view.instant}: {what}"
        yield f"<figure><figcaption>{html.escape(text)}</figcaption>{picture}</figure>"


def _error(done: Calibrated, view: View) -> float:
    """Return the root-mean-square error of a view, pixels; of one that was left out as infinite."""
    if view.instant not in done.solved.state.boards or any(view is other for other in done.dropped):
        return float("inf")
    return float(np.sqrt((done.solved.state.errors(view) ** 2).sum(axis=1).mean()))


def _plans(done: Calibrated) -> str:
    rig, state = done.rig, done.world.state
    boards = {i: pose.apply(done.board.corners) for i, pose in state.boards.items()}
    points = np.concatenate([rig.centers, *boards.values()])
    person = person_points(rig)
    low, high = points.min(axis=0) - 0.7, points.max(axis=0) + 0.7
    plans = []
    for title, (a, b) in (("from above (x right, y up)", (0, 1)), ("from the side (x right, z up)", (0, 2))):
        span = max(high[0] - low[0], high[1] - low[1])
        scale = 600 / span
        width, height = scale * (high[a] - low[a]), scale * (high[b] - low[b])

        def at(p: Float, a: int = a, b: int = b, scale: float = scale, height: float = height) -> str:
            return f"{scale * (p[a] - low[a]):.1f},{height - scale * (p[b] - low[b]):.1f}"

        drawn = []
        if len(person):
            box = (person.min(axis=0), person.max(axis=0))
            rim = [np.array([box[i][0], box[j][1], box[j][2]]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
            drawn.append(f'<polygon points="{" ".join(map(at, rim))}" fill="#4aa3ff" opacity="0.12"/>')
        if b == 2:
            ends = (np.array([low[0], 0, 0.0]), np.array([high[0], 0, 0.0]))
            drawn.append(f'<polyline points="{" ".join(map(at, ends))}" stroke="var(--line)" fill="none"/>')
        for i, corners in boards.items():
            color = "#2f7d4f" if i == done.world.floor else "var(--wire)"
            drawn.append(
                f'<polygon points="{" ".join(map(at, corners))}" fill="{color}" fill-opacity="0.15" stroke="{color}"/>'
            )
        for camera in rig:
            reach = np.array([camera.width, camera.height]) / 2 / camera.matrix.diagonal()[:2]
            rim = [camera.center + 0.35 * camera.rotation.T @ np.array([s * reach[0], 0.0, 1.0]) for s in (-1, 1)]
            sight = " ".join(map(at, [camera.center, *rim]))
            x, y = at(camera.center).split(",")
            name = html.escape(camera.name)
            drawn.append(
                f'<polygon points="{sight}" fill="#d35400" opacity="0.75"/>'
                f'<text x="{x}" y="{float(y) - 6:.1f}" font-size="13" text-anchor="middle">{name}</text>'
            )
        picture = _svg(width, height, "".join(drawn))
        plans.append(f"<figure><figcaption>{title}</figcaption>{picture}</figure>")
    key = (
        '<p class="muted">Orange: cameras. Outlines: boards (green: on the floor). Blue: the space in which the error '
        "is computed.</p>"
    )
    return f'{key}<div class="plans">{"".join(plans)}</div>'


def _pairs(done: Calibrated, verdict: Verdict) -> str:
    counts = {frozenset((a, b)): (shared, agree) for a, b, shared, agree in verdict.pairs}
    rows = [_row(("instants shared", *done.names), "th")]
    for a in done.names:
        cells = [a]
        for b in done.names:
            shared, agree = counts.get(frozenset((a, b)), (0, 0)) if a != b else (0, 0)
            cells.append(
                "" if a == b else "–" if not shared else str(shared) if shared == agree else f"{agree} of {shared}"
            )
        rows.append(_row(cells))
    note = '<p class="muted">"3 of 5": five instants are shared, three agree on the pose in the first estimate.</p>'
    return f"<table>{''.join(rows)}</table>{note}"


def _determined(verdict: Verdict) -> str:
    rows = [_row(("camera", "lens model", "error in held-out views", "by the images", "by priors"), "th")]
    for one in verdict.cameras:
        rows.append(_row((one.name, one.model, _held_out(one), _by_images(one), ", ".join(one.by_prior) or "none")))
    note = (
        '<p class="muted">By priors: the images reduce the uncertainty by less than half. Priors: square pixels, the '
        "principal point near the centre, weak distortion.</p>"
    )
    return f"<table>{''.join(rows)}</table>{note}"


def _held_out(one: CameraVerdict) -> str:
    return ", ".join(f"{name} {error:.3f} px" for name, error in one.held_out_px.items()) or "no choice"


def _by_images(one: CameraVerdict) -> str:
    return {
        "given": "none: --intrinsics",
        "held": "focal length, k1, k2",
        "free": "all others" if one.by_prior else "all",
    }[one.how]
