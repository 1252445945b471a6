"""The widgets of a live view: picture, curve, hemisphere, sliders around a :class:`~.session.Session`.

All rendering happens in the notebook's own thread, a frame at a time between its messages. So no cell, slider or
second view meets Dr.Jit in the middle of a frame, and none waits longer than for one; while a cell runs, the picture
stands still. Frames are asked for by the page, which must be there and have shown the last one (``jupyter_rfb``).
"""

from __future__ import annotations

import asyncio
import html
import time
import weakref
from collections import deque

import ipywidgets as w
import numpy as np
from jupyter_rfb import RemoteFrameBuffer

from mi_neural.explore import panels, pictures, views
from mi_neural.image import exr

#: What the picture's place can show.
SHOWN = ("picture", "reliability", "visibility", "visibility, traced")
#: Seconds between updates of the hemisphere and of the curve, which take longer than others.
HEMISPHERE_SECONDS, CURVE_SECONDS = 0.5, 2.0
#: Seconds between frames in which the notebook's messages are read; reading one takes several turns of its loop.
BREATH = 0.01
#: Degrees a CSS pixel of a drag turns, distance factor of a wheel's unit, and the drag that still is a click.
DRAG_DEGREES, WHEEL_FACTOR, CLICK_PIXELS = 0.4, 1.001, 4


class Canvas(RemoteFrameBuffer):
    """Where frames appear and the mouse is heard: `frame()` gives a frame, `hear(event)` takes events."""

    def __init__(self, frame, hear, **traits) -> None:
        self._frame, self._hear = frame, hear
        super().__init__(**traits)

    def get_frame(self):
        return self._frame()

    def handle_event(self, event) -> None:
        self._hear(event)


class LiveView(w.VBox):
    """A live view of a session, see :func:`mi_neural.live`. Only one runs at a time: starting it stops the others."""

    _running: weakref.ref | None = None

    def __init__(self, session, frames: int = 1, width: int = 480) -> None:
        self.session = session
        self.hemisphere: views.Hemisphere | None = None
        self.visibility: views.VisibilityMap | None = None
        self.running, self._times, self._drawn = False, deque(maxlen=16), {}
        self._press: tuple | None = None
        self._drag: tuple | None = None
        session.run(frames)
        self.exposure = exr.automatic_exposure(session.image) if frames else 0.0

        size = session.size
        self._css = (width, round(width * size[1] / size[0]))
        self.canvas = Canvas(self._frame, self._hear, css_width=f"{self._css[0]}px", css_height=f"{self._css[1]}px",
                             resizable=False, quality=92, cursor="crosshair")  # fmt: skip
        self.status = w.HTML()
        self.curve, self.disks = w.Image(format="png"), w.Image(format="png")
        self.disks_caption = w.HTML("<small>Click in the picture: light that arrives there, by direction.</small>")
        self._bar = self._make_bar()
        self.camera = panels.CameraPanel(session, self._moved)
        self.lights = panels.LightsPanel(session, self._changed)
        self.settings = panels.SettingsPanel(session, self._changed)
        self.tabs = w.Tab([self.camera, self.lights, self.settings], titles=("Camera", "Lights", "Integrator"))
        beside = w.VBox([self.curve, self.disks_caption, self.disks])
        super().__init__([self._bar, w.HBox([w.VBox([self.canvas, self.status]), beside]), self.tabs])
        self._draw_curve()
        self.go()

    def _make_bar(self) -> w.HBox:
        self._run = w.ToggleButton(False, description="Stop", icon="stop", layout=w.Layout(width="auto"))
        self._run.observe(lambda change: self.stop() if change["new"] else self.go(), "value")
        home = w.Button(description="Home", icon="home", tooltip="camera and lights as at first",
                        layout=w.Layout(width="auto"))  # fmt: skip
        home.on_click(lambda _: self.home())
        forget = w.Button(description="Forget", icon="eraser", tooltip="begin to learn anew",
                          layout=w.Layout(width="auto"))  # fmt: skip
        forget.on_click(lambda _: self.forget())
        self._shown = w.Dropdown(options=SHOWN, layout=w.Layout(width="9.5em"))
        self._light = w.BoundedIntText(0, min=0, max=2**20, description="of light", layout=w.Layout(width="11em"))
        self._light.layout.display = "none"
        self._shown.observe(self._choose, "value")
        self._light.observe(self._choose, "value")
        bright = w.FloatSlider(0.0, min=-4, max=4, step=0.25, description="exposure", readout_format="+.2f",
                               layout=w.Layout(width="20em"))  # fmt: skip
        bright.observe(lambda change: self._expose(change["new"] - change["old"]), "value")
        return w.HBox([self._run, home, forget, self._shown, self._light, bright])

    def _repr_mimebundle_(self, **kwargs):
        """As every widget, and the picture as it is now for readers who have no widgets."""
        bundle = super()._repr_mimebundle_(**kwargs)
        data = bundle[0] if isinstance(bundle, tuple) else bundle
        if data is not None:
            data["image/png"] = exr.png_bytes(self.session.picture(self.exposure))
        return bundle

    # -------------------------------------------------------------------------------------------------------------
    # For programs and people

    @property
    def rate(self) -> float:
        """Frames a second, over the latest 16; 0 before there are two."""
        return (len(self._times) - 1) / (self._times[-1] - self._times[0]) if len(self._times) > 1 else 0.0

    def go(self) -> None:
        """Go on rendering, and stop the view that did so far."""
        other = LiveView._running() if LiveView._running is not None else None
        if other is not None and other is not self:
            other.stop()
        LiveView._running = weakref.ref(self)
        self.running = True
        self._times.clear()
        self._run.set_trait("value", False)
        self.canvas.request_draw()

    def stop(self) -> None:
        """Stop after the frame being rendered."""
        self.running = False
        self._run.set_trait("value", True)
        self._tell()

    def show(self, what: str = "picture", light: int = 0) -> None:
        """Show one of SHOWN; `light` is the number of the light whose visibility is meant."""
        if what not in SHOWN:
            raise ValueError(f"there is no view '{what}'; give one of: {', '.join(SHOWN)}")
        self._light.value, self._shown.value = light, what

    def click(self, x: float, y: float) -> None:
        """Show the hemisphere of light that arrives at the surface in pixel (x, y)."""
        try:
            self.hemisphere = views.Hemisphere(self.session.scene, self.session.integrator, (x, y), self.session.sensor)
        except views.Unavailable as why:
            self.disks_caption.value = _small(str(why))
            return
        self._drawn.pop("disks", None)
        self._draw_disks()

    def home(self) -> None:
        """Camera and lights as at first."""
        self.session.home()
        self.camera.move(azimuth=0.0, elevation=0.0, distance=1.0)
        self.lights.take_up()
        self._changed()

    def forget(self) -> None:
        """Begin to learn anew."""
        self.session.forget()
        self._changed()

    # -------------------------------------------------------------------------------------------------------------
    # Frames

    def _frame(self):
        """The next frame as uint8 (height, width, 3); called by the page's demand."""
        if not self.running:
            return self._shown_now()
        try:
            self.session.frame()
            self._times.append(time.perf_counter())
            frame = self._shown_now()
            self._draw_disks()
            self._draw_curve()
            self._tell()
        except Exception as error:
            self.stop()
            self.status.value = f"<b>{html.escape(type(error).__name__)}</b>: {html.escape(str(error))}"
            raise
        self._next()
        return frame

    def _next(self) -> None:
        """Ask for the next frame, after a breath."""
        try:
            asyncio.get_running_loop().call_later(BREATH, self.canvas.request_draw)
        except RuntimeError:  # no notebook
            self.canvas.request_draw()

    def _shown_now(self) -> np.ndarray:
        what, session = self._shown.value, self.session
        try:
            if what == "reliability":
                view = views.ReliabilityMap(session.scene, session.integrator, session.sensor)
                return pictures.colours(view.predicted())
            if what.startswith("visibility"):
                return pictures.colours(self._visibility(what), "gray")
        except ValueError as why:  # nothing of the kind here, or no such light
            self._shown.value = "picture"
            self.disks_caption.value = _small(str(why))
        return session.picture(self.exposure)

    def _visibility(self, what: str) -> np.ndarray:
        if self.visibility is None or self.visibility.light != self._light.value:
            s = self.session
            self.visibility = views.VisibilityMap(s.scene, s.integrator, self._light.value, s.sensor)
        if what == "visibility":
            return self.visibility.predicted()
        self.visibility.add(1)
        return self.visibility.traced

    def _due(self, name: str, seconds: float) -> bool:
        now = time.perf_counter()
        if now - self._drawn.get(name, -np.inf) < seconds:
            return False
        self._drawn[name] = now
        return True

    def _draw_disks(self) -> None:
        h = self.hemisphere
        if h is None or not self._due("disks", HEMISPHERE_SECONDS):
            return
        h.add(4)
        try:
            predicted, left = h.predicted(), "as the cache says"
        except views.Unavailable as why:
            predicted, left = np.zeros_like(h.traced), str(why)
        self.disks.value = pictures.side_by_side([predicted, h.traced], self.exposure)
        place = ", ".join(f"{v:.3g}" for v in h.position)
        text = f"Indirect light that arrives at ({place}): {left}; path-traced, {h.spp} paths a direction"
        self.disks_caption.value = _small(text)

    def _draw_curve(self) -> None:
        if not self._due("curve", CURVE_SECONDS):
            return
        self.session.measure()
        self.curve.value = pictures.curve_png(self.session.curve)

    def _tell(self) -> None:
        s = self.session
        parts = [f"{s.taken} samples a pixel", f"{self.rate:.1f} frames a second" if self.running else "stopped"]
        if np.isfinite(s.loss):
            parts.insert(1, f"loss {s.loss:.3g}")
        self.status.value = ", ".join(parts)

    # -------------------------------------------------------------------------------------------------------------
    # Events

    def _moved(self) -> None:
        """The camera is elsewhere."""
        self.visibility = None
        self.canvas.request_draw()

    def _changed(self) -> None:
        """A light or a key is another."""
        if self.hemisphere is not None:
            self.hemisphere.restart()
        self._moved()

    def _choose(self, _) -> None:
        self._light.layout.display = None if self._shown.value.startswith("visibility") else "none"
        self.canvas.request_draw()

    def _expose(self, stops: float) -> None:
        self.exposure += stops
        self._drawn.pop("disks", None)
        self.canvas.request_draw()

    def _hear(self, event) -> None:
        kind = event["type"]
        if kind == "wheel":
            self.camera.move(distance=self.session.camera.distance * WHEEL_FACTOR ** event["dy"])
        elif kind == "pointer_down" and event["button"] == 1:
            camera = self.session.camera
            self._press, self._drag = (event["x"], event["y"]), (camera.azimuth, camera.elevation)
        elif kind == "pointer_move" and self._press is not None:
            dx, dy = event["x"] - self._press[0], event["y"] - self._press[1]
            if max(abs(dx), abs(dy)) > CLICK_PIXELS:
                self.camera.move(azimuth=self._drag[0] - DRAG_DEGREES * dx, elevation=self._drag[1] + DRAG_DEGREES * dy)
        elif kind == "pointer_up" and self._press is not None:
            if max(abs(event["x"] - self._press[0]), abs(event["y"] - self._press[1])) <= CLICK_PIXELS:
                (width, height), (w_css, h_css) = self.session.size, self._css
                x, y = int(event["x"] / w_css * width), int(event["y"] / h_css * height)
                self.click(min(max(x, 0), width - 1), min(max(y, 0), height - 1))
            self._press = None


def _small(text: str) -> str:
    return f"<small>{html.escape(text)}</small>"


