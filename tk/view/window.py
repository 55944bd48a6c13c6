"""The window: keys move through time and switch parts on and off, the mouse turns the view."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tk.errors import DisplayError, ExportError
from tk.render.palette import BACKGROUND, unit_rgb
from tk.render.scene import FIELD_OF_VIEW_DEG, camera_towards
from tk.system import LINUX
from tk.view.contents import SIZE, Contents

_ALTERNATIVE = "tk report RESULT.h5 writes an HTML page to look at instead"
_KEYS = (
    "space: play   arrows: one frame   page up, page down: ten   home, end   "
    "B body, J joints, H hull, T truth, C cameras, F floor: show or hide   Q: close"
)
# key codes of GLFW
_SPACE = ord(" ")
_RIGHT, _LEFT, _, _, _PAGE_UP, _PAGE_DOWN, _HOME, _END = range(262, 270)
_PAGE_FRAMES = 10
_IDLE_S = 0.01  # sleep between two events; longer ones would delay frames, shorter ones load the processor


def require_display() -> None:
    """Check that there is a display: without one, Open3D never returns or ends the process."""
    if not LINUX:
        return
    if not os.environ.get("DISPLAY"):
        wayland = " (Wayland alone is not enough: Open3D needs XWayland)" if os.environ.get("WAYLAND_DISPLAY") else ""
        raise DisplayError(f"tk view: there is no display: DISPLAY is not set{wayland}; {_ALTERNATIVE}")
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise DisplayError(f"tk view: {error}; install libx11-6; {_ALTERNATIVE}") from None
    x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    handle = x11.XOpenDisplay(None)
    if not handle:
        raise DisplayError(f"tk view: the display {os.environ['DISPLAY']} cannot be opened; {_ALTERNATIVE}")
    x11.XCloseDisplay(handle)


class Window:
    """The window of `tk view`. It prints its keys, and a line about each frame, on stderr."""

    def __init__(self, contents: Contents) -> None:
        try:
            from open3d.visualization import VisualizerWithKeyCallback
        except (ImportError, OSError) as error:
            raise DisplayError(f"tk view: needs Open3D, which does not load: {error}; {_ALTERNATIVE}") from None
        self._contents = contents
        self._window = VisualizerWithKeyCallback()
        if not self._window.create_window(f"{contents.people.first.path.name} - tk view", *SIZE):
            raise DisplayError(
                f"tk view: Open3D cannot open a window: install OpenGL (Debian: libgl1-mesa-dri); {_ALTERNATIVE}"
            )
        self._window.get_render_option().background_color = np.array(unit_rgb(BACKGROUND))
        self._shown = dict.fromkeys(contents.names, True)
        self._row, self._playing, self._due = -1, False, 0.0

    def save(self, row: int, target: Path) -> None:
        """Draw a frame into an image file, and close."""
        self._show(row)
        self._window.poll_events()
        self._window.capture_screen_image(target, do_render=True)
        self._window.destroy_window()
        if not target.is_file():
            raise ExportError(f"{target}: cannot be written; choose another folder")

    def run(self, row: int) -> None:
        """Show the window until it is closed."""
        count = len(self._contents.people.first)
        steps = {_RIGHT: 1, _LEFT: -1, _PAGE_UP: -_PAGE_FRAMES, _PAGE_DOWN: _PAGE_FRAMES, _HOME: -count, _END: count}
        for key, step in steps.items():
            self._on_key(key, partial(self._step, step))
        for name in self._shown:
            self._on_key(ord(name[0].upper()), partial(self._toggle, name))
        self._on_key(_SPACE, self._play_or_pause)
        self._window.register_animation_callback(self._tick)
        print(_KEYS, file=sys.stderr)
        self._show(row)
        self._window.run()
        self._window.destroy_window()

    def _on_key(self, key: int, action: Callable[[], None]) -> None:
        def pressed(_: Any) -> bool:
            action()
            return True  # draw again

        self._window.register_key_callback(key, pressed)

    def _show(self, row: int) -> None:
        """Draw a frame."""
        first_time = self._row < 0
        if row != self._row:
            print(self._contents.line(row), file=sys.stderr)
        self._row = row
        self._window.clear_geometries()
        for name in (name for name, shown in self._shown.items() if shown):
            for geometry in self._contents.geometry(name, row):
                self._window.add_geometry(geometry, reset_bounding_box=first_time)
        if first_time:
            self._window.get_view_control().convert_from_pinhole_camera_parameters(_pinhole(self._contents), True)

    def _step(self, by: int) -> None:
        self._show(int(np.clip(self._row + by, 0, len(self._contents.people.first) - 1)))

    def _toggle(self, name: str) -> None:
        self._shown[name] = not self._shown[name]
        self._show(self._row)

    def _play_or_pause(self) -> None:
        self._playing, self._due = not self._playing, time.monotonic()

    def _tick(self, _: Any) -> bool:
        """Show the next frame when it is due; return whether the window has to be drawn. Open3D calls it."""
        now, fps = time.monotonic(), self._contents.people.first.meta.fps
        if not self._playing or now < self._due:
            time.sleep(_IDLE_S)
            return False
        skipped = int((now - self._due) * fps)  # a slow machine skips frames
        self._due += (skipped + 1) / fps
        self._show((self._row + 1 + skipped) % len(self._contents.people.first))
        return True


def _pinhole(contents: Contents) -> Any:
    """Return Open3D's camera at :attr:`Contents.eye` that looks at the middle of the motion."""
    import open3d as o3d

    stage = contents.people.stage
    forward = stage.middle - contents.eye
    forward /= np.linalg.norm(forward)
    seen = camera_towards(contents.eye, forward, stage.axes[:, 2], SIZE, FIELD_OF_VIEW_DEG)
    focal, (width, height) = seen.matrix[0, 0], SIZE
    camera = o3d.camera.PinholeCameraParameters()
    camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = seen.rotation, seen.translation
    camera.extrinsic = T
    return camera
