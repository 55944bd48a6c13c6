"""The window: the person in three dimensions, a slider for the time, switches for what is shown."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tk.errors import ConfigError, DisplayError, ExportError, ResultError
from tk.io.captures.capture import open_capture
from tk.io.results.writer import read_result
from tk.view.contents import BACKGROUND, FIELD_OF_VIEW_DEG, SIZE, WIRE, Contents, truth_of
from tk.view.display import has_graphics_card, require_display
from tk.view.plain import PlainWindow

_FLESH = (1.0, 1.0, 1.0, 0.45)  # joints and bones are to be seen within
_HULL_POINT = 4
_HINT = "drag: turn   shift+drag: move   wheel: nearer   space: play   arrows: a frame"
# what goes by a name, where that is not one geometry of this name
_PARTS = {"joints": ("bones", "joints")}
# pictures drawn before one is kept: the first ones lack what is still on its way to the graphics card
_SETTLED = 8


def view(
    result_path: Path,
    capture_path: Path | None = None,
    frame: int | None = None,
    screenshot: Path | None = None,
) -> None:
    """Show a result in a window until it is closed: a plain one where no graphics card is behind Vulkan.

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
        truth = truth_of(result, capture_path / "truth.h5")
    if screenshot is not None and screenshot.suffix.lower() != ".png":
        raise ConfigError(f"--screenshot {screenshot}: a picture is a .png")
    if screenshot is not None and not screenshot.parent.is_dir():
        raise ExportError(f"{screenshot}: the folder {screenshot.parent} does not exist; make it first")
    require_display()
    contents, row = Contents(result, rig, truth), 0 if frame is None else known.index(frame)
    with _stdout_to_stderr():
        if has_graphics_card():
            _Window(contents, screenshot).run(row)
        elif screenshot is not None:
            PlainWindow(contents).keep(row, screenshot)
        else:
            PlainWindow(contents).run(row)


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
    def __init__(self, contents: Contents, screenshot: Path | None) -> None:
        try:
            from open3d.visualization import gui, rendering
        except (ImportError, OSError) as error:
            raise DisplayError(f"tk view: needs Open3D, which does not load here: {error}") from None
        self._gui, self._rendering = gui, rendering
        self._contents, self._result, self._screenshot = contents, contents.result, screenshot
        self._row = -1
        self._playing, self._due = False, 0.0
        self._ticks, self._failure = 0, ""
        self._app = gui.Application.instance
        try:
            self._app.initialize()
            self._window = self._app.create_window(f"{contents.result.path.name} - tk view", *SIZE)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            mend = "; on Debian: apt install libvulkan1 mesa-vulkan-drivers" if "ulkan" in reason else ""
            raise DisplayError(f"tk view: Open3D cannot open a window: {reason}{mend}") from None
        self._scene = gui.SceneWidget()
        self._scene.scene = rendering.Open3DScene(self._window.renderer)
        self._scene.scene.set_background((*BACKGROUND, 1.0))
        self._build_panel()
        self._window.add_child(self._scene)
        self._window.add_child(self._panel)
        self._window.set_on_layout(self._lay_out)
        self._window.set_on_tick_event(self._tick)
        self._window.set_on_key(self._key)
        self._materials = {
            "body": self._material("defaultLitTransparency", _FLESH),
            "bones": self._material("unlitLine", width=2.5),
            "joints": self._material("defaultLit"),
            "hull": self._material("defaultUnlit"),
            "truth": self._material("defaultLit"),
            "cameras": self._material("unlitLine"),
            "floor": self._material("unlitLine", width=1.0),
        }
        for camera in contents.rig or ():
            self._scene.add_3d_label(camera.center, camera.name).color = gui.Color(*WIRE)

    def run(self, row: int) -> None:
        """Show the window until it is closed."""
        self._show(row)
        self._look()
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
        for name in self._contents.names:
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

    def _look(self) -> None:
        contents, scene = self._contents, self._scene.scene
        up = contents.stage.axes[:, 2]
        self._scene.setup_camera(FIELD_OF_VIEW_DEG, scene.bounding_box, contents.stage.middle)
        self._scene.look_at(contents.stage.middle, contents.eye, up)
        sun = -(0.6 * contents.level + 0.35 * contents.stage.axes[:, 1] + up)
        scene.set_lighting(
            self._rendering.Open3DScene.LightingProfile.NO_SHADOWS, (sun / np.linalg.norm(sun)).astype(np.float32)
        )

    # --- a frame

    def _show(self, row: int, anew: bool = False) -> None:
        if row == self._row and not anew:
            return
        self._row = row
        scene = self._scene.scene
        for name, box in self._boxes.items():
            for part in _PARTS.get(name, (name,)):
                scene.remove_geometry(part)
            if box.checked:
                for part, geometry in self._contents.geometry(name, row).items():
                    scene.add_geometry(part, geometry, self._materials[part])
        self._slider.int_value = row
        self._told.text = self._contents.line(row)
        self._window.post_redraw()

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
