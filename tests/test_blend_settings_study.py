"""`studies/blend_settings.py`: how the sun turns, and direct light of several samples."""

from types import SimpleNamespace

import numpy as np
import pytest
from load_study import load_study

blend_settings = load_study("blend_settings")


@pytest.mark.parametrize("slow, states", [(False, 2), (True, 11)])
def test_sun_turns_at_once_or_slowly_to_the_same_place(slow, states):
    down = np.array([0.6, -0.8, 0.0])
    (turn,) = blend_settings.change_of("glossy_hall", "sun.direction", slow).functions.values()
    values = [turn(frame, down) for frame in range(60)]
    assert len({tuple(np.round(v, 6)) for v in values}) == states
    assert all(np.allclose(v, down) for v in values[:20]) and not np.allclose(values[20], down)
    angle = np.degrees(np.arctan2(values[-1][2], values[-1][0]))
    assert abs(angle) == pytest.approx(blend_settings.TURN) and values[-1][1] == pytest.approx(-0.8)


def test_direct_light_of_several_samples_is_the_mean_over_frames_of_one_state():
    image = lambda k: SimpleNamespace(layer=lambda name: np.full((2, 2, 3), 2.0**k))  # noqa: E731
    run = SimpleNamespace(sequence=SimpleNamespace(states=["a", "a", "b", "b", "b"]))
    found = SimpleNamespace(run=run, results={"EMA": SimpleNamespace(image=image)})
    samples = lambda frame, n: blend_settings.direct_samples(found, "EMA", frame, n)[0, 0, 0]  # noqa: E731
    assert samples(0, 1) == 1 and samples(0, 2) == 1.5 == samples(1, 2)
    assert samples(4, 1) == 16 and samples(4, 2) == (16 + 4) / 2 and samples(3, 3) == (4 + 8 + 16) / 3


def test_settings_differ_from_the_first_in_what_they_name():
    first = next(iter(blend_settings.VARIANTS.values()))
    assert first == ({}, {}) and blend_settings.SLOW in blend_settings.VARIANTS
    for name, (keys, more) in blend_settings.VARIANTS.items():
        assert all(f"{k}={v:g}" in name for k, v in keys.items() if v is not None)
        assert str(more.get("pretrain", "")) in name
