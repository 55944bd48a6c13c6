"""All settings of the program, as frozen dataclasses. Each part goes to the tracker or the segmentation that needs it.

Files of settings are read and written by :mod:`tk.io.settings_file`. Parameters of an algorithm that no user sets are
constants beside the algorithm.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from tk.errors import ConfigError

#: largest count in a settings file: frames, points, iterations
MOST_COUNT = 100_000
#: largest weight, ratio or threshold. Beside it the other terms, whose defaults are 0.1 to 3, no longer count.
MOST_WEIGHT = 1000


def _check(table: str, values: Any, **ranges: tuple[float, float]) -> None:
    """Raise ConfigError for a value of a settings table that is outside its closed range, or NaN."""
    for name, (low, high) in ranges.items():
        value = getattr(values, name)
        if not low <= value <= high:
            raise ConfigError(f"{table}.{name} = {value} must lie in [{low:g}, {high:g}]")


@dataclass(frozen=True)
class ForegroundSettings:
    """Masks made against the empty scene.

    Attributes:
        threshold: least difference between a person's pixel and the scene, in noise variances; pure noise gives 0.5. A
            lower value finds more of the person and more false pixels. Measured on rendered captures with exact masks.
        shadow_min: brightness of the darkest shadow, as a share of the lit scene; 1 if there are no shadows. A lower
            value accepts darker shadows, but makes holes in dark clothes, which cut through the visual hull. Measured
            under two lamps: 0.76.
    """

    threshold: float = 3.0
    shadow_min: float = 0.7

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            if not 0 < getattr(self, name) <= MOST_WEIGHT:
                raise ConfigError(f"foreground.{name} = {getattr(self, name)} must lie in (0, {MOST_WEIGHT}]")
        if self.shadow_min > 1:
            raise ConfigError(f"foreground.shadow_min = {self.shadow_min} must be at most 1, which means no shadows")


@dataclass(frozen=True)
class VolumetricSettings:
    """The terms of the objective of --method volumetric; the weight of its surface term is 1.

    Attributes:
        colors: whether a point of the body looks only among voxels of its colour (section 6.1.3 of the paper).
        coverage_weight: weight of the distances from the visual hull to the body; 0 leaves them out, as the paper does.
        edge_weight: weight of the distances from the body's contours to edges in the images (6.1.2); 0 leaves them out.
            The paper prints no weights.
    """

    colors: bool = True
    coverage_weight: float = 0.7
    edge_weight: float = 0.1

    def __post_init__(self) -> None:
        _check("volumetric", self, coverage_weight=(0, MOST_WEIGHT), edge_weight=(0, MOST_WEIGHT))


@dataclass(frozen=True)
class SilhouetteSettings:
    """How contours are tracked, by --method region and silhouette; for every method, the body fit and how often limbs
    are searched.

    Attributes:
        prediction: share of the last frame's motion that is predicted for the next one (the silhouette paper: 0, which
            it found as good; half of the motion helps when arms and legs swing).
        adapt: whether the body is fitted to the silhouettes.
        init_frames: frames that the initialisation looks at; a stride is about one second.
        search_every: seconds between two routine limb searches, 0: none; --method region also searches on evidence.
        lost_error: a frame is lost if its E_S, averaged over the views, exceeds this.
    """

    prediction: float = 0.5
    adapt: bool = True
    init_frames: int = 24
    search_every: float = 0.7
    lost_error: float = 0.6

    def __post_init__(self) -> None:
        _check("silhouette", self, init_frames=(1, 1000), search_every=(0, 5), prediction=(0, 1.5))
        if not 0 < self.lost_error <= 10:
            raise ConfigError(f"silhouette.lost_error = {self.lost_error} must lie in (0, 10]")


@dataclass(frozen=True)
class RegionSettings:
    """How --method region searches.

    Attributes:
        hypotheses: most poses that are tracked at the same time.
        false_alarm: probability with which the residual of a right pose counts as high in a frame. A high residual
            triggers a limb search; if it lasts, a search for the person. Below 3e-7 it never does.
        colors: whether the colours of the segments are learned and used.
    """

    hypotheses: int = 3
    false_alarm: float = 0.02
    colors: bool = True

    def __post_init__(self) -> None:
        _check("region", self, hypotheses=(1, 20), false_alarm=(1e-12, 0.5))


#: values of :attr:`Settings.landmarks`
LANDMARK_MODES = ("auto", "always", "never")


@dataclass(frozen=True)
class Settings:
    """All settings of a run.

    Attributes:
        voxels: voxels along the working volume's longest side (the paper: 64 and 128).
        seed: seed of the random numbers: candidate poses of the limb search, and the volumetric tracker's samples.
        ahead: frames that a separate process decodes and segments ahead of the tracker; 0: no such process, each frame
            is prepared when the tracker asks for it. The result is the same.
        effort: how much the volumetric tracker computes. 1: the paper's numbers of iterations and points (6.4). A
            number below 1 is the share of the iterations, a number above 1 multiplies the points; the paper compares
            1 and 5 in its section 7.3.
        refine: whether inconsistent cameras are refined before the second pass.
        resample: whether each frame's images are chosen by their time stamps, for cameras of different or variable
            rates. A frame for which a camera has no image within half an interval is blank in this camera.
        landmarks: in which frames a network's landmarks are used, see :mod:`tk.model.cues.landmarks`. "auto": those
            that the network sees for its masks, and those in which the silhouettes leave a limb open, if a network is
            installed with its weights; "always": all (about a second of processor time a frame set); "never": none.
        person_pixels: least height in pixels at which a person is tracked. The images of a camera that shows the person
            at n times this height are read at 1/n of their size; 0: all at full size. Measured: at 250 to 350 pixels
            limbs are as accurate as at 620; at 205 they are 0.1 cm worse, at 150 0.2 to 0.4 cm, at 100 0.5 to 3 cm.
    """

    voxels: int = 64
    seed: int = 0
    ahead: int = 4
    effort: float = 1.0
    refine: bool = True
    resample: bool = False
    landmarks: str = "auto"
    person_pixels: int = 240
    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    volumetric: VolumetricSettings = field(default_factory=VolumetricSettings)
    silhouette: SilhouetteSettings = field(default_factory=SilhouetteSettings)
    region: RegionSettings = field(default_factory=RegionSettings)

    def __post_init__(self) -> None:
        if not 8 <= self.voxels <= 512:
            raise ConfigError(f"voxels = {self.voxels}: choose from 8 to 512")
        if not 0 <= self.seed < 2**63:  # the result file stores it as an int64
            raise ConfigError(f"seed = {self.seed}: choose from 0 to {2**63 - 1}")
        if not 0 <= self.ahead <= 64:
            raise ConfigError(f"ahead = {self.ahead}: choose from 0 to 64 frames")
        if self.landmarks not in LANDMARK_MODES:
            raise ConfigError(f"landmarks = {self.landmarks!r}: choose from {', '.join(LANDMARK_MODES)}")
        if not 0 <= self.person_pixels <= MOST_COUNT:
            raise ConfigError(f"person_pixels = {self.person_pixels}: choose from 0 (full size) to {MOST_COUNT}")
        if not 0.05 <= self.effort <= 20:
            raise ConfigError(f"effort = {self.effort}: choose from 0.05 to 20; 1 is normal")
