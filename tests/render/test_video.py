"""Videos: complete or absent, playable, and replaced only with --force."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from tests.conftest import Tk
from tk.errors import DiskFullError, ExportError
from tk.io.paths import replacing
from tk.io.results.reader import read_result
from tk.model.body.joints import SEGMENTS
from tk.render.palette import SEGMENT_COLORS
from tk.render.scene import HEIGHT, WIDTH, Scene
from tk.render.video import made_here, video_writer


def moving(count: int) -> list[np.ndarray]:
    """Return images of a bright square that moves to the right over grey."""
    pictures = np.full((count, 64, 96, 3), 60, np.uint8)
    for k, picture in enumerate(pictures):
        picture[20:40, 4 * k : 4 * k + 20] = (40, 200, 240)
    return list(pictures)


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        (stream,) = container.streams
        assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(stream)]


def test_video_contains_its_images(tmp_path: Path) -> None:
    path = tmp_path / "square.mp4"
    pictures = moving(12)
    with video_writer(path, 29.97) as add:
        for picture in pictures:
            add(picture)
    found = decoded(path)
    assert len(found) == 12
    for picture, seen in zip(pictures, found, strict=True):
        assert np.abs(picture.astype(int) - seen).mean() < 4
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a browser can begin before all is loaded"
    assert made_here(path)
    assert list(tmp_path.iterdir()) == [path], "nothing is left beside it"


def test_error_keeps_the_earlier_video(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(b"precious")
    with pytest.raises(RuntimeError, match="while drawing"), video_writer(path, 15) as add:
        add(moving(1)[0])
        raise RuntimeError("while drawing")
    with pytest.raises(Exception, match=r".+"), video_writer(path, 15) as add:  # the encoder's own complaint
        for _ in range(20):
            add(np.zeros((63, 95, 3), np.uint8))
    assert path.read_bytes() == b"precious" and list(tmp_path.iterdir()) == [path]
    assert not made_here(path)


@pytest.mark.parametrize("when", ["at once", "at the end"])
def test_full_disk_ends_the_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    original = av.open

    @contextmanager
    def full(*given: Any, **options: Any) -> Iterator[Any]:
        if when == "at the end":
            with original(*given, **options) as container:
                yield container
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(av, "open", full)
    with pytest.raises(DiskFullError, match="No space left"), video_writer(tmp_path / "video.mp4", 15) as add:
        for picture in moving(20):
            add(picture)


def test_file_is_renamed_when_complete(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    with replacing(path) as part:
        part.write_text("half")
        assert not path.exists()
    assert path.read_text() == "half"
    with pytest.raises(ExportError, match="cannot be written"), replacing(tmp_path / "no" / "page.html") as part:
        part.write_text("")


def test_3d_view_turns_and_shows_body_or_hull(tracked: Path) -> None:
    result = read_result(tracked)
    body, hull = Scene(result), Scene(result, hull=True)
    first, last = body.picture(0), body.picture(len(result) - 1)
    assert first.shape == (756, 960, 3)
    assert (first[:720] != last[:720]).any(axis=2).mean() > 0.02, "it turns, and the person moves"
    voxels = hull.picture(0)
    differ = (voxels[:720] != first[:720]).any(axis=2)
    assert 0.01 < differ.mean() < 0.5, "the hull in the place of the body"
    # where the person is in one picture, there is the person in the other
    y, x = np.nonzero(differ)
    pelvis = body._camera(0).project(result.joints[0, 0])[0][0]
    assert abs(x.mean() - pelvis[0]) < 60 and abs(y.mean() - pelvis[1]) < 120


def test_3d_view_shows_the_nearest_solid_in_each_pixel(tracked: Path) -> None:
    scene = Scene(read_result(tracked))
    eye, figure = scene._camera(0), scene.people.figures[0]
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    scene._draw_bodies(image, eye, 0)
    own = [eye.to_camera(points) for points in np.split(figure.placed(0), figure.starts[1:-1])]
    triangles = np.concatenate([points[s.triangles] for s, points in zip(figure.solids, own, strict=True)])
    owner = np.repeat([s.segment for s in figure.solids], [len(s.triangles) for s in figure.solids])
    edges = np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=-1)
    drawn = np.argwhere(image.any(axis=2))
    checked = 0
    for y, x in drawn[:: len(drawn) // 60]:
        nearest = set()
        for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
            ray = np.linalg.inv(eye.matrix) @ (x + dx, y + dy, 1.0)
            system = np.concatenate([edges, np.broadcast_to(-ray[:, None], (len(edges), 3, 1))], axis=-1)
            crosses = np.abs(np.linalg.det(system)) > 1e-12  # not parallel to the triangle, which has an area
            solution = np.full((len(edges), 3), -1.0)
            solution[crosses] = np.linalg.solve(system[crosses], -triangles[crosses, 0, :, None])[..., 0]
            u, v, depth = solution.T
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0)
            nearest.add(int(owner[hit][np.argmin(depth[hit])]) if hit.any() else -1)
        if len(nearest) == 1 and -1 not in nearest:  # else the pixel is a mixture
            color, base = image[y, x].astype(float), np.array(SEGMENT_COLORS[SEGMENTS[nearest.pop()]], float)
            np.testing.assert_allclose(color, base * (color.sum() / base.sum()), atol=2)
            checked += 1
    assert checked > 30


def test_render_writes_the_requested_views_and_frames(tracked: Path, tiny: Path, tmp_path: Path, tk: Tk) -> None:
    for name, arguments, frames in (
        ("overlay.mp4", [tiny, "--frames", "2:6"], 4),
        ("3d.mp4", ["--view", "3d", "--frames", "1,3"], 2),
        ("hull.mp4", ["--view", "hull", "--frames", ":3"], 3),
    ):
        ran = tk("render", tracked, *arguments, "-o", tmp_path / name)
        assert ran.code == 0 and f"wrote {tmp_path / name}" in ran.err
        found = decoded(tmp_path / name)
        assert len(found) == frames and found[0].std() > 10
    before = (tmp_path / "3d.mp4").read_bytes()
    tk("render", tracked, "-o", tmp_path / "3d.mp4").complaint("3d.mp4: exists", "--force")
    assert (tmp_path / "3d.mp4").read_bytes() == before
    assert tk("render", tracked, "-o", tmp_path / "3d.mp4", "--frames", "1", "--force").code == 0
    assert (tmp_path / "3d.mp4").read_bytes() != before
    tk("render", tracked, "-o", tmp_path / "3d.avi").complaint("a video of tk must end in .mp4")
