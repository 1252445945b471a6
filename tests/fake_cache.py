"""An integrator with the protocol of this package's own and a cache that is one number: tests of the tools use it.

It renders `path` times 1 + 1 / (1 + frames trained), so that training shows in the image.
"""

from pathlib import Path
from time import sleep

import mitsuba as mi


def register() -> None:
    """Make `fake_cache` known to Mitsuba under the current variant."""

    class FakeCache(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.inner = mi.load_dict({"type": "path", "max_depth": props.get("max_depth", -1)})
            self.fraction = props.get("fraction", 0.5)
            self.interrupt_render = props.get("interrupt_render", -1)  # in the n-th render call from now
            self.interrupt_train = props.get("interrupt_train", False)
            self.nan = props.get("nan", False)  # a NaN in every image
            self.fail = props.get("fail", False)  # refuse every scene
            self.frames = self.n_renders = self.n_prepared = 0
            self.seconds = 0.0

        def sample(self, scene, sampler, ray, medium=None, active=True):
            L, valid, _ = self.inner.sample(scene, sampler, ray, medium, active)
            L *= 1.0 + 1.0 / (1.0 + self.frames)
            if self.nan:  # without further channels: beside them Mitsuba's film shows a NaN as 0
                return mi.Spectrum(float("nan")), valid, []
            return L, valid, [mi.Float(self.frames)]

        def aov_names(self):
            return [] if self.nan else ["frames"]

        def render(self, scene, sensor, seed=0, spp=0, develop=True, evaluate=True):
            self.n_renders += 1
            if self.n_renders == self.interrupt_render:
                raise KeyboardInterrupt
            return super().render(scene, sensor, seed, spp, develop, evaluate)

        def train(self, scene, frames, sensor=0, progress=None):
            for k in range(frames):
                if self.interrupt_train:
                    raise KeyboardInterrupt
                self.frames += 1
                self.seconds += 1e-6
                if progress:
                    progress(k + 1, frames)
            return self.statistics()

        def train_seconds(self, scene, seconds, sensor=0):
            if self.interrupt_train:
                raise KeyboardInterrupt
            sleep(seconds)
            self.frames += 10
            self.seconds += seconds
            return self.statistics()

        def train_fraction(self, seconds):
            return self.fraction

        def prepare(self, scene, sensor=0, spp=1):
            if self.fail:
                raise ValueError("fake_cache: this scene cannot be rendered")
            self.n_prepared += 1
            n, self.n_renders = self.n_renders, -1_000_000  # not counted
            self.render(scene, scene.sensors()[sensor], 1, spp)
            self.n_renders = n

        def statistics(self):
            return {"seconds_train": self.seconds, "records": self.frames, "ns_per_query": 100.0, "queries": 7}

        def reset(self):
            self.frames, self.seconds = 0, 0.0

        def save_cache(self, path):
            Path(path).write_text(f"fake {self.frames}")

        def load_cache(self, path):
            kind, _, frames = Path(path).read_text().partition(" ")
            if kind != "fake":
                raise ValueError(f"{path} is no cache file of fake_cache")
            self.frames = int(frames)

        def to_string(self):
            return "FakeCache[]"

    mi.register_integrator("fake_cache", lambda props: FakeCache(props))
