"""Render a synthetic capture with ground truth: a clothed, implicit actor in a textured room.

The capture that ships with the package was made by ``python -m scripts.make_capture --out tk/data/demo --seed 7``.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import click

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # `python scripts/make_capture.py` works as well

from scripts.synthetic.actor import Look
from scripts.synthetic.capture import Options, crossings, plan_capture, write_capture
from scripts.synthetic.motion import MOTIONS
from scripts.synthetic.rig import RIGS
from scripts.synthetic.scenes import SCENES


class SizeType(click.ParamType[tuple[int, int]]):
    """``WxH`` in pixels."""

    name = "WxH"

    def convert(
        self, value: str | tuple[int, int], param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        try:
            width, height = (int(part) for part in value.lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a size like 640x480", param, ctx)
        if width < 32 or height < 32 or width % 2 or height % 2:
            self.fail(f"{value}: width and height must be even (H.264) and at least 32", param, ctx)
        return width, height


class ColorType(click.ParamType[tuple[float, float, float]]):
    """``#rrggbb``, converted to linear light."""

    name = "#rrggbb"

    def convert(
        self, value: str | tuple[float, float, float], param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value
        digits = value.lstrip("#")
        try:
            if len(digits) != 6:
                raise ValueError
            r, g, b = ((byte / 255) ** 2.2 for byte in bytes.fromhex(digits))
        except ValueError:
            self.fail(f"{value!r} is not a colour like #b03030", param, ctx)
        return r, g, b


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder of the capture.")
@click.option("--motion", type=click.Choice([*MOTIONS, *SCENES]), default="demo", show_default=True)
@click.option(
    "--only", type=click.IntRange(min=0), multiple=True, help="Render only this person of a scene (repeatable)."
)
@click.option("--frames", type=click.IntRange(min=1), help="Number of frames [default: the motion's own length].")
@click.option("--fps", type=click.FloatRange(5, 240), help="Frames a second [default: the motion's own].")
@click.option("--cameras", type=click.Choice([str(n) for n in RIGS]), default="5", show_default=True)
@click.option("--size", type=SizeType(), default="640x480", show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of cameras and noise.")
@click.option("--masks", is_flag=True, help="Also write exact masks.")
@click.option("--shirt", type=ColorType(), help="Colour of the T-shirt.")
@click.option("--stripes", is_flag=True, help="A striped T-shirt.")
@click.option("--trousers", type=ColorType(), help="Colour of the trousers.")
@click.option("--height", type=click.FloatRange(1.2, 2.1), default=1.75, show_default=True, help="Stature, metres.")
@click.option("--crf", type=click.IntRange(0, 51), default=20, show_default=True, help="x264's rate factor.")
def main(
    out: Path,
    motion: str,
    only: tuple[int, ...],
    frames: int | None,
    fps: float | None,
    cameras: str,
    size: tuple[int, int],
    seed: int,
    masks: bool,
    shirt: tuple[float, float, float] | None,
    stripes: bool,
    trousers: tuple[float, float, float] | None,
    height: float,
    crf: int,
) -> None:
    """Render a capture (videos, background clips, calibration, truth) into a folder."""
    look = Look(stripes=stripes)
    if shirt is not None:
        look = replace(look, shirt=shirt)
    if trousers is not None:
        look = replace(look, trousers=trousers)
    if fps is not None and motion in SCENES:
        raise click.UsageError("--fps: a scene of several people has its own rate")
    options = Options(motion, frames, int(cameras), size, seed, height, look, crf, only or None, fps)
    started = time.perf_counter()

    def progress(done: int, total: int) -> None:
        if done % 10 == 0 or done == total:
            click.echo(f"{done}/{total} frames, {time.perf_counter() - started:.0f} s", err=True)

    try:
        plan = plan_capture(options)
    except ValueError as error:  # nobody has this number
        raise click.UsageError(str(error)) from None
    if len(plan.people) > 1:
        click.echo(f"{crossings(plan)} crossings", err=True)
    write_capture(plan, out, masks=masks, name=out.resolve().name, progress=progress)


if __name__ == "__main__":
    main()
