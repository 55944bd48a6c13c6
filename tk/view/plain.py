"""A plain window, drawn through OpenGL, for machines whose processor draws: keys in the place of the slider."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tk.errors import DisplayError, ExportError
from tk.view.contents import BACKGROUND, FIELD_OF_VIEW_DEG, SIZE, Contents

_HINT = (
    "space: play   arrows: a frame   page up, page down: ten   home, end   "
    "B body, J joints, H hull, T truth, C cameras, F floor: shown or not   Q: close"
)
# GLFW's numbers of keys
_SPACE, _RIGHT, _LEFT, _PAGE_UP, _PAGE_DOWN, _HOME, _END = 32, 262, 263, 266, 267, 268, 269
_PAGE = 10
_IDLE_S = 0.01  # between two looks at the clock


class PlainWindow:
    """The window. What the other window writes below its picture goes to stderr.

    Raises:
        DisplayError: it cannot be opened.
    """

    def __init__(self, contents: Contents) -> None:
        try:
            from open3d.visualization import VisualizerWithKeyCallback
        except (ImportError, OSError) as error:
            raise DisplayError(f"tk view: needs Open3D, which does not load here: {error}") from None
        self._contents = contents
        self._window = VisualizerWithKeyCallback()
        if not self._window.create_window(f"{contents.result.path.name} - tk view", *SIZE):
            raise DisplayError("tk view: Open3D cannot open a window; it needs OpenGL (Debian: libgl1-mesa-dri)")
        self._window.get_render_option().background_color = np.array(BACKGROUND)
        self._shown = dict.fromkeys(contents.names, True)
        self._row, self._playing, self._due = -1, False, 0.0

    def keep(self, row: int, target: Path) -> None:
        """Draw a frame into a picture, and close.

        Raises:
            ExportError: it cannot be written.
        """
        self._show(row)
        self._window.poll_events()
        self._window.capture_screen_image(target, do_render=True)
        self._window.destroy_window()
        if not target.is_file():
            raise ExportError(f"{target}: cannot be written")

    def run(self, row: int) -> None:
        """Show the window until it is closed."""
        count = len(self._contents.result)
        steps = {_RIGHT: 1, _LEFT: -1, _PAGE_UP: -_PAGE, _PAGE_DOWN: _PAGE, _HOME: -count, _END: count}
        for key, step in steps.items():
            self._on(key, partial(self._step, step))
        for name in self._shown:
            self._on(ord(name[0].upper()), partial(self._toggle, name))
        self._on(_SPACE, self._play)
        self._window.register_animation_callback(self._tick)
        print(_HINT, file=sys.stderr)
        self._show(row)
        self._window.run()
        self._window.destroy_window()

    def _on(self, key: int, act: Callable[[], None]) -> None:
        def pressed(_: Any) -> bool:
            act()
            return True  # draw anew

        self._window.register_key_callback(key, pressed)

    def _show(self, row: int) -> None:
        """Draw a frame."""
        begins = self._row < 0
        if row != self._row:
            print(self._contents.line(row), file=sys.stderr)
        self._row = row
        self._window.clear_geometries()
        for name in (name for name, shown in self._shown.items() if shown):
            for part, geometry in self._contents.geometry(name, row).items():
                if part == "body":  # only the sides that look away: joints and bones are to be seen within
                    geometry = _inside(geometry)
                self._window.add_geometry(geometry, reset_bounding_box=begins)
        if begins:
            self._look()

    def _look(self) -> None:
        """From the contents' eye, as a pinhole camera."""
        import open3d as o3d

        contents = self._contents
        up = contents.stage.axes[:, 2]
        forward = contents.stage.middle - contents.eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        width, height = SIZE
        focal = height / 2 / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))
        camera = o3d.camera.PinholeCameraParameters()
        camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(
            width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5
        )
        T = np.eye(4)
        T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        T[:3, 3] = -T[:3, :3] @ contents.eye
        camera.extrinsic = T
        self._window.get_view_control().convert_from_pinhole_camera_parameters(camera, allow_arbitrary=True)

    def _step(self, by: int) -> None:
        self._show(int(np.clip(self._row + by, 0, len(self._contents.result) - 1)))

    def _toggle(self, name: str) -> None:
        self._shown[name] = not self._shown[name]
        self._show(self._row)

    def _play(self) -> None:
        self._playing, self._due = not self._playing, time.monotonic()

    def _tick(self, _: Any) -> bool:
        """Called as often as the window can; whether something has to be drawn."""
        now, fps = time.monotonic(), self._contents.result.meta.fps
        if not self._playing or now < self._due:
            time.sleep(_IDLE_S)
            return False
        skipped = int((now - self._due) * fps)  # a slow machine leaves frames out
        self._due += (skipped + 1) / fps
        self._show((self._row + 1 + skipped) % len(self._contents.result))
        return True


def _inside(mesh: Any) -> Any:
    """The mesh turned inside out."""
    import open3d as o3d

    mesh.triangles = o3d.utility.Vector3iVector(np.asarray(mesh.triangles)[:, ::-1])
    return mesh.compute_vertex_normals()
