"""The verdict as a table on the terminal."""

from __future__ import annotations

from tk.calibration.verdict import Verdict


def table(verdict: Verdict) -> str:
    """Return a table with one line a camera, and a line about the pairs of cameras."""
    width = max(6, *(len(one.name) for one in verdict.cameras))
    lines = [
        f"{'camera':<{width}}  lens      views  shared  error [px]  at the person [mm]   focal [px]     ±  covered"
        "  board at [m]"
    ]
    for one in verdict.cameras:
        sigma = " given" if one.how == "given" else f"{100 * one.focal_sigma:5.2f}%"
        lines.append(
            f"{one.name:<{width}}  {one.model:<8}  {one.views:5d}  {one.shared:6d}  {one.rms_px:10.2f}  "
            f"{1000 * one.rms_m:18.1f}  {one.focal_px:11.1f} {sigma}  {100 * one.covered:6.0f}%  "
            f"{one.near_m:.1f} to {one.far_m:.1f}"
        )
        if one.by_prior:
            lines.append(f"{'':<{width}}  by priors, not by the images: {', '.join(one.by_prior)}")
    if verdict.pairs:
        pairs = ", ".join(f"{a}–{b} {shared}" for a, b, shared, _ in sorted(verdict.pairs, key=lambda p: -p[2]))
        lines.append(f"instants shared: {pairs}; boards fill {100 * verdict.filled:.0f} % of the person's space")
    return "\n".join(lines)
