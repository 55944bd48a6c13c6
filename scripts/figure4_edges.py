"""Figure 4 of Kehl & Van Gool 2006 as a number: clutter of colour edges against grey-level Canny at equal recall.

True edges are the outlines of a capture's exact masks. Recall is the share of them with a detected edge within 2 px.
Clutter, in pixels a picture, is counted at the thresholds that give both detectors the same recall:

- shadow: edges outside the person where the picture differs from the empty scene (cast shadows), without those that the
  empty scene may have as well (at the low threshold);
- clothes: edges inside the person where the material is the same all around (shading and wrinkles). Materials are
  clusters of colour in which lightness counts a quarter, found in each picture. Edges between materials (sleeves,
  stripes, an arm before the trunk) are what a tracker wants and count for neither; a leg's edge before the other leg
  counts as clutter, for both.

Outlines within 3 px count for neither. Both detectors get the same Gaussian smoothing and the same ratio of thresholds.

    python -m scripts.figure4_edges CAPTURE... --out DIR [--frames 30,45,60]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

from scripts.paper.edge_maps import follow_edges, rgb_gradient, thin_edges
from tk.errors import CaptureError, TkError
from tk.io.captures.capture import open_capture

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
#: edges at a low and a high threshold
Detect = Callable[[float, float], Mask]

RECALLS = (0.8, 0.9, 0.95)
RECALL_PX = 2
BAND_PX = 3
LOW_SHARE = 0.4  # of the high threshold; Canny 1986 advises a third to a half
CHANGED = 8.0  # levels, about four times the sensor noise after smoothing
THRESHOLDS = 24
MATERIALS = 6  # skin, hair, shoes, and three for clothes
LIGHTNESS_SHARE = 0.25


def grey_canny(image: Image) -> Detect:
    """OpenCV's Canny on the grey-level picture; thresholds in levels of the Sobel magnitude."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    dx, dy = cv2.Sobel(grey, cv2.CV_16S, 1, 0), cv2.Sobel(grey, cv2.CV_16S, 0, 1)
    return lambda low, high: cv2.Canny(dx, dy, low, high, L2gradient=True) > 0


def rgb_edges(image: Image) -> Detect:
    """The colour edges of :mod:`scripts.paper.edge_maps`; thresholds of its magnitude."""
    thin = thin_edges(*rgb_gradient(image[None]))
    return lambda low, high: follow_edges(thin, low, high)[0]


@dataclass(frozen=True)
class Detector:
    """A row of the table: smoothing, then ``prepare``; ``thresholds`` from the greatest down."""

    name: str
    prepare: Callable[[Image], Detect]
    thresholds: NDArray[np.float64]
    sigma: float = 0.0

    def __call__(self, image: Image) -> Detect:
        return self.prepare(cv2.GaussianBlur(image, (0, 0), self.sigma) if self.sigma else image)


def detectors() -> tuple[Detector, ...]:
    """Both, without smoothing and with a Gaussian of 1 px."""
    colour = np.geomspace(0.6, 0.005, THRESHOLDS)
    grey = np.geomspace(1000, 8, THRESHOLDS)
    return tuple(
        Detector(name, prepare, thresholds, sigma)
        for sigma in (0.0, 1.0)
        for name, prepare, thresholds in (("RGB edges", rgb_edges, colour), ("grey Canny", grey_canny, grey))
    )


@dataclass(frozen=True)
class Picture:
    """A picture and what is known of it: the outline, one material's interior, the cast shadows."""

    image: Image  # (h, w, 3)
    plate: Image  # (h, w, 3) the empty scene
    outline: Mask  # (h, w)
    clothes: Mask
    shadow: Mask


def _disc(radius: int) -> Image:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _near(mask: Mask, radius: int) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), _disc(radius)) > 0


def _materials(image: Image, inside: Mask) -> NDArray[np.uint8]:
    """Labels 1… of the person's pixels by their colour, 0 elsewhere."""
    lab = cv2.cvtColor(cv2.medianBlur(image, 5), cv2.COLOR_BGR2LAB).astype(np.float32)
    lab[..., 0] *= LIGHTNESS_SHARE
    labels = np.zeros(inside.shape, np.uint8)
    if inside.sum() > MATERIALS:
        cv2.setRNGSeed(0)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 0.1)
        found = cv2.kmeans(lab[inside], MATERIALS, None, stop, 2, cv2.KMEANS_PP_CENTERS)[1]
        labels[inside] = found[:, 0] + 1
    return cv2.medianBlur(labels, 5)


def describe(image: Image, plate: Image, mask: Image) -> Picture:
    """Split an image by its mask (h, w) uint8 and the empty scene."""
    inside = mask > 0
    # the border of the image is not an outline
    outline = inside & (cv2.erode(mask, _disc(1), borderValue=255) == 0)
    band = _near(outline, BAND_PX)
    materials = _materials(image, inside)
    uniform = cv2.dilate(materials, _disc(BAND_PX)) == cv2.erode(materials, _disc(BAND_PX))
    away = ~_near(inside, 4 * BAND_PX)
    # corrects for flickering lamps and automatic exposure
    gain = np.median(image[away] / np.maximum(plate[away], 1.0), axis=0) if away.any() else np.ones(3)
    empty = plate * gain
    # without the person, because the blur would spread them over the floor
    without = np.where(_near(inside, BAND_PX)[..., None], empty, image)
    difference = np.abs(cv2.GaussianBlur(without - empty, (0, 0), 2.0)).max(axis=2)
    shadow = _near(difference > CHANGED, BAND_PX) & ~inside & ~band
    return Picture(image, plate, outline, inside & uniform & ~band, shadow)


def load(folder: Path, frames: Sequence[int], cameras: Sequence[str] | None = None) -> Iterator[Picture]:
    """Yield the images of some frames, camera by camera; of all cameras if None.

    Raises:
        CaptureError: the capture has no masks, no empty scene, or not all frames.
    """
    capture = open_capture(folder, cameras)
    background = capture.background()
    if not capture.has_masks or background is None:
        raise CaptureError(f"{folder}: figure 4 needs masks/ and background/; take a capture that has both")
    plates = [clip.mean(axis=0).round().astype(np.uint8) for clip in background]
    for index in frames:
        with capture.frames(index, index + 1) as reader:
            (frame,) = reader
        assert frame.masks is not None
        for camera, plate, image, mask in zip(capture.rig, plates, frame.images, frame.masks, strict=True):
            h, w = camera.height, camera.width
            yield describe(image[:h, :w], plate, mask[:h, :w])


@dataclass(frozen=True)
class Curve:
    """A detector over its thresholds, (T,) each: recall 0…1, clutter in pixels a picture."""

    recall: NDArray[np.float64]
    shadow: NDArray[np.float64]
    clothes: NDArray[np.float64]

    def at(self, recall: float, what: str) -> float:
        """``"shadow"`` or ``"clothes"`` at this recall, between thresholds linearly; NaN where it is not reached."""
        return float(np.interp(recall, self.recall, getattr(self, what), left=np.nan, right=np.nan))


def measure(pictures: Sequence[Picture], detector: Detector) -> Curve:
    """Recall and clutter at each threshold, over all pictures."""
    counts = np.zeros((len(detector.thresholds), 4))
    for picture in pictures:
        detect, detect_empty = detector(picture.image), detector(picture.plate)
        for row, high in zip(counts, detector.thresholds, strict=True):
            low = LOW_SHARE * high
            edges = detect(low, high)
            # everything that hysteresis could follow from the person's own edges
            static = detect_empty(low, low)
            moving = edges & ~_near(static, RECALL_PX)
            row += (
                (_near(edges, RECALL_PX) & picture.outline).sum(),
                picture.outline.sum(),
                (moving & picture.shadow).sum(),
                (edges & picture.clothes).sum(),
            )
    hits, outline, shadow, clothes = counts.T
    return Curve(np.maximum.accumulate(hits / outline), shadow / len(pictures), clothes / len(pictures))


def table(curves: dict[str, list[tuple[Detector, Curve]]]) -> str:
    """Markdown: a row a capture and detector."""
    lines = [
        "| capture | detector | σ px | " + " | ".join(f"shadow @{r:.0%} | clothes @{r:.0%}" for r in RECALLS) + " |",
        "|---|---|---|" + "---|---|" * len(RECALLS),
    ]
    for name, rows in curves.items():
        for detector, curve in rows:
            cells = " | ".join(f"{curve.at(r, 'shadow'):.1f} | {curve.at(r, 'clothes'):.1f}" for r in RECALLS)
            lines.append(f"| {name} | {detector.name} | {detector.sigma:g} | {cells} |")
    return "\n".join(lines)


def draw(picture: Picture, rows: list[tuple[Detector, Curve]], recall: float, path: Path) -> None:
    """The paper's four panels a detector at one recall, and the curves."""
    figure, axes = plt.subplots(2, 3, figsize=(15, 8), layout="constrained")
    known = picture.image[..., ::-1].copy()
    known[picture.shadow] = known[picture.shadow] // 2 + np.array([0, 90, 127], np.uint8)
    known[picture.clothes] = known[picture.clothes] // 2 + np.array([0, 110, 0], np.uint8)
    known[picture.outline] = (255, 0, 255)
    axes[0, 0].imshow(known)
    axes[0, 0].set_title("outline (magenta), cast shadow (blue), one material (green)")
    for axis, (detector, curve) in zip((axes[0, 1], axes[0, 2], axes[1, 1], axes[1, 2]), rows, strict=True):
        # recall rises as the threshold falls
        threshold = np.exp(np.interp(recall, curve.recall, np.log(detector.thresholds)))
        axis.imshow(~detector(picture.image)(LOW_SHARE * threshold, threshold), cmap="gray")
        axis.set_title(f"{detector.name}, σ = {detector.sigma:g} px, recall {recall:.0%} over all pictures")
    for axis in axes.flat:
        axis.set_axis_off()
    axis = axes[1, 0]
    axis.set_axis_on()
    for detector, curve in rows:
        style = "-" if detector.sigma == 0 else "--"
        color = "tab:red" if detector.prepare is rgb_edges else "0.4"
        axis.plot(
            curve.recall,
            curve.shadow + curve.clothes,
            style,
            color=color,
            label=f"{detector.name}, σ={detector.sigma:g}",
        )
    axis.set(
        xlabel="recall of the outline", ylabel="clutter, px a picture (shadow + clothes)", xlim=(0.4, 1), ylim=(0, 1000)
    )
    axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def run(
    folders: Sequence[Path], frames: Sequence[int], out: Path, cameras: Sequence[str] | None = None
) -> dict[str, list[tuple[Detector, Curve]]]:
    """Measure each capture, write ``figure4-<capture>.png`` and ``figure4.md`` into ``out``, return the curves."""
    out.mkdir(parents=True, exist_ok=True)
    curves: dict[str, list[tuple[Detector, Curve]]] = {}
    for folder in folders:
        pictures = list(load(folder, frames, cameras))
        rows = curves[folder.name] = [(detector, measure(pictures, detector)) for detector in detectors()]
        shown = max(pictures, key=lambda picture: int(picture.shadow.sum()))
        draw(shown, rows, RECALLS[1], out / f"figure4-{folder.name}.png")
    (out / "figure4.md").write_text(table(curves) + "\n", encoding="utf-8")
    return curves


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Clutter of colour edges against grey-level Canny (figure 4)")
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE", help="with masks/ and background/")
    parser.add_argument("--out", type=Path, required=True, help="folder for the table and the pictures")
    parser.add_argument("--frames", default="30,45,60", help="frame numbers, comma-separated")
    parser.add_argument("--cameras", help="names, comma-separated; all of them by default")
    arguments = parser.parse_args(argv)
    cameras = arguments.cameras.split(",") if arguments.cameras else None
    try:
        curves = run(arguments.captures, [int(f) for f in arguments.frames.split(",")], arguments.out, cameras)
    except TkError as error:
        raise SystemExit(str(error)) from None
    print(table(curves))


if __name__ == "__main__":
    main()
