"""How exactly a flash can give an offset: the folders of ``raw_folders`` without pictures, as shares of light.

    python -m scripts.flash_floor --seeds 30

Prints errors of the estimate of ``tk sync``, and of an observer who knows how these folders are made: the shape of the
shares, and the distributions of exposure and readout.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from tk.synchronise.flash import Event, ties_of_changes
from tk.synchronise.ties import solve

Float = NDArray[np.float64]

#: exposure and readout, shares of an interval: the ranges of ``raw_folders``
EXPOSED, READ = (0.15, 0.6), (0.15, 0.4)
#: common times of the changes, seconds
FOUR = (3.013, 3.42, 7.13, 7.71)
EIGHT = (3.013, 3.42, 4.2, 4.91, 6.0, 6.37, 7.13, 7.71)
#: error of a share: coding, and a person who moves
NOISE = 0.01


def share(after: Float, exposed: Float, read: Float) -> Float:
    """Return the share of light in an image whose middle is ``after`` seconds after the change."""

    def total(at: Float) -> Float:  # integral of the share of a row
        inside = np.clip(at, -exposed / 2, exposed / 2) + exposed / 2
        return np.asarray(inside**2 / (2 * exposed) + np.maximum(at - exposed / 2, 0))

    return np.asarray((total(after + read / 2) - total(after - read / 2)) / read)


class KnownModel(Event):
    """A change whose likelihood is that of the folders."""

    def likelihood(self, times: Float) -> Float:
        """Return (E, N), see :meth:`Event.likelihood`."""
        exposed, read = np.meshgrid(np.linspace(0.17, 0.58, 6), np.linspace(0.19, 0.36, 3))
        lengths = (each.ravel()[:, None, None] * self.interval_s for each in (exposed, read))
        lit = share(self.times_s - times[:, None], *lengths)
        return np.asarray(np.exp(-0.5 * (((self.lit - lit) / (3 * NOISE)) ** 2).sum(axis=2)))


def errors_ms(fps: int, lamp: Float, seed: int, kind: type[Event]) -> Float:
    """Return (3,) errors of the offsets of four cameras: the second has another rate, the third lacks images."""
    random = np.random.default_rng(seed)
    lamp = lamp + random.uniform(0, 1 / fps)
    events: list[list[Event]] = []
    offsets = []
    for c in range(4):
        ticks = np.arange(int((lamp[-1] + 2) * fps))
        step = 1.25 if c == 1 and fps > 20 else 1.0
        ticks = np.unique(np.rint(ticks * step).astype(int))
        if c == 2:
            ticks = ticks[random.random(len(ticks)) > 0.1]
        exposed, read, phase = random.uniform([EXPOSED[0], READ[0], -0.5], [EXPOSED[1], READ[1], 0.5]) * step / fps
        times, offset = ticks / fps + phase, random.uniform(-0.02, 0.02)
        offsets.append(offset)
        events.append([])
        for change in lamp:
            lit = share(times - change, exposed, read)
            first, last = np.flatnonzero(lit < 0.02)[-1], np.flatnonzero(lit > 0.98)[0]
            lit, near = lit[first : last + 1], times[first : last + 1] - offset
            lit = np.clip(lit + NOISE * random.standard_normal(len(lit)), 0, 1)
            lit[0], lit[-1] = 0, 1
            own = float(near[(lit * (1 - lit)).argmax()] if len(lit) > 2 else near.mean())
            interval = float(np.median(np.diff(times)))
            events[-1].append(kind(own, interval, 45.0, near, lit, float(np.hypot(0.1, NOISE))))
    clocks = solve(4, ties_of_changes([{c: events[c][k] for c in range(4)} for k in range(len(lamp))]))
    return np.asarray(1000 * (clocks.offsets_s - offsets + offsets[0])[1:])


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=30)
    seeds = range(parser.parse_args().seeds)
    print("| images/s | changes | who | rms, ms | largest of two folders, median, ms | two folders within 5 ms |")
    print("|---|---|---|---|---|---|")
    for fps, lamp in ((15, FOUR), (25, FOUR), (15, EIGHT)):
        for who, kind in (("tk sync", Event), ("who knows the folders", KnownModel)):
            errors = np.abs([errors_ms(fps, np.array(lamp), seed, kind) for seed in seeds])
            two = errors.max(axis=1)[: len(seeds) // 2 * 2].reshape(-1, 2).max(axis=1)
            cells = f"{np.sqrt((errors**2).mean()):.1f} | {np.median(two):.1f} | {100 * np.mean(two <= 5):.0f} %"
            print(f"| {fps} | {len(lamp)} | {who} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
