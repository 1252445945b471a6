"""Sliders for a session."""

from __future__ import annotations

import ipywidgets as w
import numpy as np

from mi_neural.explore.controls import settings
from mi_neural.image import exr

_WIDE = w.Layout(width="28em")


def _slider(name: str, value: float, low: float, high: float, step: float, form: str = ".2f") -> w.FloatSlider:
    return w.FloatSlider(value, min=low, max=high, step=step, description=name, readout_format=form, layout=_WIDE)


# ------------------------------------------------------------------------------------------------------------------
# Sliders


class CameraPanel(w.VBox):
    """Orbit and distance of a session's camera; `changed()` is called after each move."""

    def __init__(self, session, changed) -> None:
        self.session, self.changed = session, changed
        self.sliders = {
            "azimuth": _slider("azimuth", 0, -180, 180, 1, ".0f"),
            "elevation": _slider("elevation", 0, -89, 89, 1, ".0f"),
            "distance": w.FloatLogSlider(1.0, base=2, min=-4, max=4, step=0.05, description="distance", layout=_WIDE),
        }
        for slider in self.sliders.values():
            slider.observe(self._move, "value")
        super().__init__(list(self.sliders.values()))

    def _move(self, _) -> None:
        self.session.turn(**{name: slider.value for name, slider in self.sliders.items()})
        self.changed()

    def move(self, **values: float) -> None:
        """Move the sliders named, and so the camera; an azimuth may exceed a turn."""
        for name, value in values.items():
            self.sliders[name].value = (value + 180) % 360 - 180 if name == "azimuth" else value


class LightsPanel(w.VBox):
    """Brightness, colour, place and direction of one light of a session at a time; `changed()` after each change."""

    def __init__(self, session, changed) -> None:
        self.session, self.changed, self._quiet = session, changed, False
        if not session.lights:
            super().__init__([w.HTML("None of the scene's lights can be changed.")])
            return
        box = session.scene.bbox()
        extent = float(np.max(np.array(box.max) - np.array(box.min)))
        self.choice = w.Dropdown(options=[(light.name, k) for k, light in enumerate(session.lights)],
                                 description="light", layout=_WIDE)  # fmt: skip
        self.stops = _slider("brightness", 0, -6, 6, 0.1, "+.1f")
        self.colour = w.ColorPicker(description="colour")
        self.offset = [_slider(f"{a} +", 0, -0.5 * extent, 0.5 * extent, 0.005 * extent, ".3g") for a in "xyz"]
        self.azimuth, self.elevation = _slider("turn", 0, -180, 180, 1, ".0f"), _slider("tilt", 0, -180, 180, 1, ".0f")
        controls = [self.stops, self.colour, *self.offset, self.azimuth, self.elevation]
        for control in controls:
            control.layout = w.Layout(width=_WIDE.width)
            control.observe(self._set, "value")
        self.choice.observe(self.take_up, "value")
        super().__init__([self.choice, *controls])
        self.take_up()

    def _set(self, _) -> None:
        if self._quiet:
            return
        has_colour = self.session.lights[self.choice.value].colour is not None
        self.session.light(
            self.choice.value, stops=self.stops.value, colour=linear(self.colour.value) if has_colour else None,
            offset=tuple(s.value for s in self.offset), azimuth=self.azimuth.value, elevation=self.elevation.value,
        )  # fmt: skip
        self.changed()

    def take_up(self, _=None) -> None:
        """Show the chosen light as it is, and the sliders of what it has."""
        if not self.session.lights:
            return
        light = self.session.lights[self.choice.value]
        self._quiet = True
        self.stops.value, self.azimuth.value, self.elevation.value = (
            light.now[name] for name in ("stops", "azimuth", "elevation")
        )
        for slider, value in zip(self.offset, light.now["offset"], strict=True):
            slider.value = value
        if light.colour is not None:
            self.colour.value = hexadecimal(light.now["colour"])
        self._quiet = False
        possible = [(self.colour, light.colour is not None), (self.azimuth, light.can_turn),
                    (self.elevation, light.can_turn), *((s, light.can_move) for s in self.offset)]  # fmt: skip
        for control, shown in possible:
            control.layout.display = None if shown else "none"


class SettingsPanel(w.VBox):
    """The keys of a session's integrator that can be set while it renders; `changed()` after each change."""

    def __init__(self, session, changed) -> None:
        self.session, self.changed = session, changed
        samples = w.SelectionSlider(options=sorted({1, 2, 4, 8, 16, session.spp}), value=session.spp,
                                    description="samples a frame", continuous_update=False)  # fmt: skip
        samples.observe(lambda change: setattr(session, "spp", change["new"]), "value")
        rows = [samples, *(self._control(setting) for setting in settings(session.integrator))]
        for row in rows:
            row.style.description_width, row.layout = "9em", _WIDE
        super().__init__(rows)

    def _control(self, setting) -> w.Widget:
        own = getattr(self.session.integrator, setting.name)
        if isinstance(own, bool):
            control = w.Checkbox(own, description=setting.name)
        else:
            text = isinstance(own, str)
            options = [(v if text else f"{v:g}", v) for v in setting.choices(self.session.integrator)]
            make, more = (w.Dropdown, {}) if text else (w.SelectionSlider, {"continuous_update": False})
            control = make(options=options, value=own, description=setting.name, **more)

        def set_key(change):
            self.session.set(setting.name, change["new"])
            self.changed()

        control.observe(set_key, "value")
        return control


def linear(text: str) -> np.ndarray:
    """'#ff8000' as linear RGB."""
    srgb = np.array([int(text[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def hexadecimal(rgb) -> str:
    """Linear RGB in [0, 1] as '#ff8000'."""
    return "#" + "".join(f"{v:02x}" for v in exr.to_srgb8(np.asarray(rgb, float)[None, None])[0, 0])
