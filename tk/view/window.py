"""The window: the person in three dimensions, a slider for the time, switches for what is shown."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, DisplayError, ExportError, ResultError
from tk.io.capture import open_capture
from tk.io.result import Result, read_joints, read_result
from tk.io.result_data import STATUS_MEANING
from tk.model.camera import Rig
from tk.render.figure import figure_of
from tk.render.scene import Stage
from tk.view import shapes

Float = NDArray[np.float64]

SIZE = (1280, 860)
_BACKGROUND = (0.11, 0.12, 0.135, 1.0)
_FLOOR, _WIRE, _BONE = (0.32, 0.34, 0.37, 1.0), (0.62, 0.68, 0.78, 1.0), (0.95, 0.95, 0.95, 1.0)
_FLESH = (1.0, 1.0, 1.0, 0.45)  # joints and bones are to be seen within
_FIELD_OF_VIEW_DEG = 40.0
_ELEVATION_DEG = 14.0
_HULL_POINT = 4
_HINT = "drag: turn   shift+drag: move   wheel: nearer   space: play   arrows: a frame"
# pictures drawn before one is kept: the first ones lack what is still on its way to the graphics card
_SETTLED = 8


def view(
    result_path: Path,
    capture_path: Path | None = None,
    frame: int | None = None,
    screenshot: Path | None = None,
) -> None:
    """Show a result in a window until it is closed.

    Args:
        result_path: the result.
        capture_path: its capture: cameras, where the result has none, and the truth, where there is one.
        frame: to begin with; the first by default.
        screenshot: a PNG file; the frame is drawn into it, and the window closed.

    Raises:
        DisplayError: there is no display, or Open3D cannot draw on it.
        TkError: the result or the capture cannot be used, or the picture cannot be written.
    """
    result = read_result(result_path)
    if not len(result):
        raise ResultError(f"{result_path}: has no frames")
    known = result.frames.tolist()
    if frame is not None and frame not in known:
        raise ConfigError(f"--frame {frame}: the result has frames {min(known)} to {max(known)}")
    rig = result.cameras.rig if result.cameras else None
    truth = None
    if capture_path is not None:
        rig = rig or open_capture(capture_path, masks="none").rig
        truth = _truth(result, capture_path / "truth.h5")
    if screenshot is not None and screenshot.suffix.lower() != ".png":
        raise ConfigError(f"--screenshot {screenshot}: a picture is a .png")
    if screenshot is not None and not screenshot.parent.is_dir():
        raise ExportError(f"{screenshot}: the folder {screenshot.parent} does not exist; make it first")
    require_display()
    with _stdout_to_stderr():
        _Window(result, rig, truth, screenshot).run(0 if frame is None else known.index(frame))


def require_display() -> None:
    """Raise DisplayError where there is no display: without one Open3D waits for ever, or ends the process."""
    if sys.platform != "linux":
        return
    other = "without one, tk render draws a video"
    if not os.environ.get("DISPLAY"):
        wayland = " (Wayland alone does not do: Open3D needs XWayland)" if os.environ.get("WAYLAND_DISPLAY") else ""
        raise DisplayError(f"tk view: there is no display, for DISPLAY is not set{wayland}; {other}")
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise DisplayError(f"tk view: {error}; install libx11-6; {other}") from None
    x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    handle = x11.XOpenDisplay(None)
    if not handle:
        raise DisplayError(f"tk view: the display {os.environ['DISPLAY']} cannot be opened; {other}")
    x11.XCloseDisplay(handle)


def _truth(result: Result, path: Path) -> Float | None:
    """(F, 15, 3) the true joints in the result's frames; NaN where the truth has none."""
    if not path.exists():
        return None
    truth = read_joints(path)
    places = np.full((len(result), *truth.positions.shape[1:]), np.nan)
    _, mine, theirs = np.intersect1d(result.frames, truth.frames, return_indices=True)
    places[mine] = truth.positions[theirs]
    return places


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Open3D's engine tells what it found on stdout, below Python."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


class _Window:
    def __init__(self, result: Result, rig: Rig | None, truth: Float | None, screenshot: Path | None) -> None:
        try:
            from open3d.visualization import gui, rendering
        except (ImportError, OSError) as error:
            raise DisplayError(f"tk view: needs Open3D, which does not load here: {error}") from None
        self._gui, self._rendering = gui, rendering
        self._result, self._rig, self._truth, self._screenshot = result, rig, truth, screenshot
        self._figure = figure_of(result)
        self._stage = Stage.of(result, self._figure)
        self._row = -1
        self._playing, self._due = False, 0.0
        self._ticks, self._failure = 0, ""
        self._app = gui.Application.instance
        try:
            self._app.initialize()
            self._window = self._app.create_window(f"{result.path.name} - tk view", *SIZE)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            mend = "; on Debian: apt install libvulkan1 mesa-vulkan-drivers" if "ulkan" in reason else ""
            raise DisplayError(f"tk view: Open3D cannot open a window: {reason}{mend}") from None
        self._scene = gui.SceneWidget()
        self._scene.scene = rendering.Open3DScene(self._window.renderer)
        self._scene.scene.set_background(_BACKGROUND)
        self._build_panel()
        self._window.add_child(self._scene)
        self._window.add_child(self._panel)
        self._window.set_on_layout(self._lay_out)
        self._window.set_on_tick_event(self._tick)
        self._window.set_on_key(self._key)
        self._add_what_stays()
        self._look()

    def run(self, row: int) -> None:
        """Show the window until it is closed."""
        self._show(row)
        self._app.run()
        if self._failure:
            raise ExportError(self._failure)

    # --- what is in the window

    def _build_panel(self) -> None:
        gui, em = self._gui, self._window.theme.font_size
        self._panel = gui.Vert(0.35 * em, gui.Margins(0.8 * em, 0.5 * em, 0.8 * em, 0.5 * em))
        line = gui.Horiz(0.8 * em)
        self._play = gui.Button("Play")
        self._play.set_on_clicked(self._toggle)
        line.add_child(self._play)
        self._slider = gui.Slider(gui.Slider.INT)
        self._slider.set_limits(0, max(len(self._result) - 1, 1))
        self._slider.set_on_value_changed(lambda value: self._show(int(value)))
        line.add_child(self._slider)
        self._panel.add_child(line)
        line = gui.Horiz(1.2 * em)
        self._told = gui.Label(" " * 90)
        line.add_child(self._told)
        line.add_stretch()
        self._boxes: dict[str, Any] = {}
        there = {
            "body": bool(self._figure.solids),
            "joints": True,
            "hull": self._result.hull is not None,
            "truth": self._truth is not None,
            "cameras": self._rig is not None,
            "floor": True,
        }
        for name in (name for name, is_there in there.items() if is_there):
            box = self._boxes[name] = gui.Checkbox(name)
            box.checked = True
            box.set_on_checked(lambda _: self._show(self._row, anew=True))
            line.add_child(box)
        self._panel.add_child(line)
        self._panel.add_child(gui.Label(_HINT))

    def _lay_out(self, context: Any) -> None:
        gui, area = self._gui, self._window.content_rect
        height = self._panel.calc_preferred_size(context, gui.Widget.Constraints()).height
        self._scene.frame = gui.Rect(area.x, area.y, area.width, area.height - height)
        self._panel.frame = gui.Rect(area.x, area.get_bottom() - height, area.width, height)

    def _material(self, shader: str, color: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0), width: float = 1.5) -> Any:
        material = self._rendering.MaterialRecord()
        material.shader, material.base_color = shader, color
        scale = self._window.scaling
        material.line_width, material.point_size = width * scale, _HULL_POINT * scale
        material.base_roughness = 0.6
        return material

    def _add_what_stays(self) -> None:
        scene = self._scene.scene
        scene.add_geometry("floor", shapes.floor_lines(self._stage), self._material("unlitLine", _FLOOR, 1.0))
        if self._rig is not None:
            wires = self._material("unlitLine", _WIRE)
            scene.add_geometry("cameras", shapes.camera_lines(self._rig), wires)
            for camera in self._rig:
                self._scene.add_3d_label(camera.center, camera.name).color = self._gui.Color(*_WIRE[:3])

    def _look(self) -> None:
        """From aside and a little above, all that moves and some of the room in sight."""
        stage = self._stage
        up = stage.axes[:, 2]
        level = stage.axes @ np.array([np.cos(0.6), np.sin(0.6), 0.0])
        elevation = np.radians(_ELEVATION_DEG)
        distance = 1.25 * stage.radius / np.sin(np.radians(_FIELD_OF_VIEW_DEG / 2))
        eye = stage.middle + distance * (np.cos(elevation) * level + np.sin(elevation) * up)
        self._scene.setup_camera(_FIELD_OF_VIEW_DEG, self._scene.scene.bounding_box, stage.middle)
        self._scene.look_at(stage.middle, eye, up)
        sun = -(0.6 * level + 0.35 * stage.axes[:, 1] + up)
        self._scene.scene.set_lighting(
            self._rendering.Open3DScene.LightingProfile.NO_SHADOWS, (sun / np.linalg.norm(sun)).astype(np.float32)
        )

    # --- a frame

    def _show(self, row: int, anew: bool = False) -> None:
        if row == self._row and not anew:
            return
        self._row = row
        figure, scene = self._figure, self._scene.scene
        joints = figure.joints[row]
        sigma = None if figure.sigma is None else figure.sigma[row]
        self._replace("body", "body", lambda: shapes.body_mesh(figure, row), "defaultLitTransparency", _FLESH)
        self._replace("bones", "joints", lambda: shapes.skeleton_lines(joints), "unlitLine", _BONE, 2.5)
        self._replace("joints", "joints", lambda: shapes.joint_spheres(joints, sigma), "defaultLit")
        if (hull := self._result.hull) is not None:
            self._replace("hull", "hull", lambda: shapes.hull_cloud(hull[row]), "defaultUnlit")
        if (truth := self._truth) is not None:
            self._replace("truth", "truth", lambda: shapes.truth_spheres(truth[row]), "defaultLit")
        for name in ("cameras", "floor"):
            scene.show_geometry(name, self._is_on(name))
        self._slider.int_value = row
        self._told.text = self._line()
        self._window.post_redraw()

    def _replace(
        self, name: str, box: str, make: Any, shader: str, color: Any = (1.0,) * 4, width: float = 1.5
    ) -> None:
        scene = self._scene.scene
        scene.remove_geometry(name)
        if self._is_on(box) and not (geometry := make()).is_empty():
            scene.add_geometry(name, geometry, self._material(shader, color, width))

    def _is_on(self, name: str) -> bool:
        return name in self._boxes and bool(self._boxes[name].checked)

    def _line(self) -> str:
        """What there is to say of the frame."""
        result, row = self._result, self._row
        parts = [f"frame {result.frames[row]}", f"{result.time[row]:.2f} s", STATUS_MEANING[result.status[row]]]
        if result.fit_error is not None and np.isfinite(result.fit_error[row]).any():
            parts.append(f"E_S {100 * np.nanmean(result.fit_error[row]):.1f} %")
        if result.sigma is not None and np.isfinite(result.sigma[row]).any():
            parts.append(f"median sigma {100 * np.nanmedian(result.sigma[row]):.1f} cm")
        return "    ".join(parts)

    # --- what happens

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.text = "Pause" if self._playing else "Play"
        self._due = time.monotonic()

    def _key(self, event: Any) -> bool:
        gui = self._gui
        if event.type != gui.KeyEvent.DOWN:
            return False
        steps = {gui.KeyName.LEFT: -1, gui.KeyName.RIGHT: 1}
        if event.key == gui.KeyName.SPACE:
            self._toggle()
        elif event.key in steps:
            self._show(int(np.clip(self._row + steps[event.key], 0, len(self._result) - 1)))
        else:
            return False
        return True

    def _tick(self) -> bool:
        """Called many times a second; whether something has to be drawn."""
        if self._screenshot is not None:
            self._ticks += 1
            if self._ticks == _SETTLED:
                self._scene.scene.scene.render_to_image(self._keep)
            return True
        now = time.monotonic()
        if not self._playing or now < self._due:
            return False
        skipped = int((now - self._due) * self._result.meta.fps)  # a slow machine leaves frames out
        self._due += (skipped + 1) / self._result.meta.fps
        self._show((self._row + 1 + skipped) % len(self._result))
        return True

    def _keep(self, image: Any) -> None:
        """Write the picture and end; an exception would not get out of the engine's loop."""
        import open3d

        target = self._screenshot
        if target is not None and not open3d.io.write_image(target, image):
            self._failure = f"{target}: cannot be written"
        self._app.quit()
