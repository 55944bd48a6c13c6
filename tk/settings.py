"""Every setting of the program, as one tree of frozen dataclasses; TOML in, TOML out.

Each default stands with its unit and source in the dataclass of the part that it belongs to.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import tomli_w

from tk.errors import ConfigError
from tk.io.toml import LARGE, parse_toml, read_text, shown
from tk.model.body.superellipsoid_body import BodySettings
from tk.model.cues.appearance import AppearanceSettings
from tk.model.cues.edge_term import ContourSettings
from tk.model.cues.objective import ObjectiveSettings
from tk.model.masks.foreground import ForegroundSettings
from tk.trackers.contour_tracker import SilhouetteSettings
from tk.trackers.region import RegionSettings

T = TypeVar("T")

SEGMENTATIONS = ("collinearity", "mog2")
PRESETS = ("kehl2006",)
EFFORTS = {"fast": 0.5, "normal": 1.0, "thorough": 5.0}

#: of whatever a configuration counts: frames, points, rounds
MOST_COUNT = 100_000


@dataclass(frozen=True)
class TrackingSettings:
    """Following a person from frame to frame.

    Attributes:
        prediction: share of the last frame's motion that the next is expected to repeat. The paper does not say how it
            predicts; at 15 Hz an arm turns by up to 31° between frames (its section 7.4).
        lost_ratio: a frame is lost whose objective exceeds that of the usual frame by this factor.
    """

    prediction: float = 0.9
    lost_ratio: float = 3.0

    def __post_init__(self) -> None:
        if not 0 <= self.prediction <= 1.5:
            raise ConfigError(f"tracking.prediction = {self.prediction} must lie in [0, 1.5]")
        if not self.lost_ratio >= 1:
            raise ConfigError(f"tracking.lost_ratio = {self.lost_ratio} must be at least 1")


@dataclass(frozen=True)
class Settings:
    """All settings of a run. Those within tables are told in the tables' classes.

    Attributes:
        voxels: voxels along the working volume's longest side (the paper: 64 and 128).
        seed: of the one random generator.
        segmentation: "collinearity" (the paper's) or "mog2".
        ahead: frames that a process of its own decodes and segments ahead of the tracker; 0: no such process, each
            frame when the tracker asks for it. The result is the same.
        effort: how much the volumetric tracker computes: "fast", "normal", "thorough", or a number. "normal", which is
            1, takes the paper's numbers of iterations and points (6.4). Less than 1 is a share of the iterations; more
            is so many times as many points: "thorough", which is 5, is what its section 7.3 compares.
        foreground: masks made against the empty scene, with segmentation = "collinearity".
        appearance: colour models, of --method volumetric, as all up to [tracking].
        body: the body.
        objective: the objective (section 6.1).
        contours: the edge term of the objective (section 6.1.2).
        tracking: following a person from frame to frame.
        silhouette: how contours are followed, by --method region and silhouette; and, for every method, how the body is
            fitted and how often other places of the limbs are tried.
        region: how --method region searches.
        refine: whether cameras that disagree about the person are refined before the second pass.
    """

    voxels: int = 64
    seed: int = 0
    segmentation: str = "collinearity"
    ahead: int = 4
    effort: str | float = "normal"
    refine: bool = True
    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    appearance: AppearanceSettings = field(default_factory=AppearanceSettings)
    body: BodySettings = field(default_factory=BodySettings)
    objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)
    contours: ContourSettings = field(default_factory=ContourSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    silhouette: SilhouetteSettings = field(default_factory=SilhouetteSettings)
    region: RegionSettings = field(default_factory=RegionSettings)

    def __post_init__(self) -> None:
        if not 8 <= self.voxels <= 512:
            raise ConfigError(f"--voxels {self.voxels}: choose from 8 to 512")
        if not 0 <= self.seed < 2**63:  # the result file keeps it as an int64
            raise ConfigError(f"--seed {self.seed}: choose from 0 to {2**63 - 1}")
        if self.segmentation not in SEGMENTATIONS:
            raise ConfigError(f'segmentation = "{self.segmentation}": choose one of {", ".join(SEGMENTATIONS)}')
        if not 0 <= self.ahead <= 64:
            raise ConfigError(f"ahead = {self.ahead}: choose from 0 to 64 frames")
        if isinstance(self.effort, str) and self.effort not in EFFORTS:
            raise ConfigError(f'effort = "{self.effort}": choose one of {", ".join(EFFORTS)}, or a number')
        if not 0.05 <= self.effort_factor <= 20:
            raise ConfigError(f"effort = {self.effort}: choose from 0.05 to 20; 1 is normal")

    @property
    def effort_factor(self) -> float:
        """``effort`` as a number."""
        return EFFORTS[self.effort] if isinstance(self.effort, str) else self.effort

    def to_toml(self) -> str:
        """The whole configuration as TOML text."""
        return tomli_w.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_toml(text: str, where: str = "configuration", base: Settings | None = None) -> Settings:
        """A configuration from TOML text; what it leaves out is as in ``base``, the defaults if None.

        Raises:
            ConfigError: unknown names, wrong types, values out of range; ``where`` names the source.
        """
        return _build(base or Settings(), parse_toml(text, where, ConfigError), where)

    @staticmethod
    def preset(name: str) -> Settings:
        """One of the :data:`PRESETS`: the settings of ``tk/data/presets/``.

        Raises:
            ConfigError: there is none of this name.
        """
        if name not in PRESETS:
            raise ConfigError(f"--preset {name}: choose one of {', '.join(PRESETS)}")
        text = (resources.files("tk") / "data" / "presets" / f"{name}.toml").read_text(encoding="utf-8")
        return Settings.from_toml(text, f"preset {name}")

    @staticmethod
    def read(path: Path, base: Settings | None = None) -> Settings:
        """A configuration file; what it leaves out is as in ``base``, the defaults if None."""
        return Settings.from_toml(read_text(path, ConfigError), str(path), base)


def _build(default: T, values: dict[str, Any], where: str, path: str = "") -> T:
    """``default`` with the values of a table put in, recursively."""
    known = {f.name: getattr(default, f.name) for f in dataclasses.fields(default)}  # type: ignore[arg-type]
    hints = get_type_hints(type(default))
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{path}{key}"
        if key not in known:
            raise ConfigError(f"{where}: unknown setting {name}; known here: {', '.join(known)}")
        old = known[key]
        if isinstance(value, int) and name != "seed" and abs(value) > MOST_COUNT:
            raise ConfigError(f"{where}: {name} = {shown(value)} is too large; give {MOST_COUNT} at most")
        if isinstance(value, float) and math.isfinite(value) and abs(value) > LARGE:
            raise ConfigError(f"{where}: {name} = {value:g} is too large; give {LARGE:g} at most")
        if dataclasses.is_dataclass(old):
            if not isinstance(value, dict):
                raise ConfigError(f"{where}: {name} must be a table")
            changes[key] = _build(old, value, where, f"{name}.")
            continue
        kinds = get_args(hints[key]) or (hints[key],)
        if float in kinds and type(value) is int:
            changes[key] = float(value)
        elif type(value) not in kinds:
            raise ConfigError(f"{where}: {name} = {shown(value)} must be of type {type(old).__name__}, as {old!r} is")
        elif isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{where}: {name} = {value} must be a finite number")
        else:
            changes[key] = value
    try:
        return dataclasses.replace(default, **changes)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
