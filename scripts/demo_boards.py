"""Render the board for `tk demo --raw`, before the empty room of the demo: `tk/data/boards/<camera>.mp4`.

python -m scripts.demo_boards
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.boards import BoardCamera, Recipe, place_boards
from scripts.synthetic.sensor import GAMMA, Sensor
from tk.calibration.boards import make_board
from tk.calibration.poses import Pose
from tk.io.captures.calibration import read_calibration
from tk.model.cameras.camera import Rig

DATA = Path(__file__).resolve().parents[1] / "tk" / "data"
#: measured side of a square, metres
SQUARE_M = 0.11
#: seen from above the centre of the demo's floor, places all over the volume, places close to each camera
_RECIPE = Recipe((), (640, 480), shared=28, close=5, seed=7, floor=False)


def mean_plate(path: Path) -> NDArray[np.float32]:
    """Return the mean image (H, W, 3) of a video, RGB, linear light."""
    with av.open(str(path)) as video:
        images = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    return np.asarray((np.mean(images, axis=0) / 255) ** GAMMA, np.float32)


def instants(rig: Rig) -> list[tuple[int | None, Pose]]:
    """Return the camera that alone sees the board (None: all), and the board's pose, of each instant.

    In the first one the board lies at the origin of the demo's world, so that the calibration has the same world.
    """
    board = make_board("charuco", None, SQUARE_M)
    poses = place_boards(_RECIPE, rig, board)
    first = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return [(None, first)] + [(None if k < 100 else (k - 100) // 20, pose) for k, pose in sorted(poses.items())]


def main() -> None:
    """Run the command."""
    board = make_board("charuco", None, SQUARE_M)
    rig = read_calibration(DATA / "demo" / "calibration.toml").rig
    folder = DATA / "boards"
    folder.mkdir(exist_ok=True)
    for c, camera in enumerate(rig):
        rng = np.random.default_rng(c)
        # the plate has gone through the camera's lens and colours already
        sensor = replace(Sensor.draw(rng, camera.width), gain=np.ones(3, np.float32), flicker=0.0, blur_px=0.5)
        sensor = replace(sensor, read_noise=0.0, shot_noise=0.0)  # noise fills 1.5 MB a camera
        renderer = BoardCamera(camera, board, sensor, mean_plate(DATA / "demo" / "background" / f"{camera.name}.mp4"))
        with av.open(str(folder / f"{camera.name}.mp4"), "w") as video:
            stream = video.add_stream("libx264", rate=1, options={"crf": "25", "preset": "slow"})
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
            for only, pose in instants(rig):
                image = renderer.render(pose if only in (None, c) else None, rng)
                video.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            video.mux(stream.encode())


if __name__ == "__main__":
    main()
