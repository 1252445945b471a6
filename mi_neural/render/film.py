"""Pixels to rays, and samples to film: the only place that makes camera rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .frozen import call, can_freeze, is_special
from .sampling import PathSampler
from .spectrum import film_colour

#: Most camera samples traced at once: 1280x720 at 16 samples then fits into 4 GiB.
PASS_SAMPLES = 2**20
#: Neighbouring pixels whose samples lie side by side: the lanes of a packet of AVX-512, half a warp.
PACKET = 16


@dataclass(frozen=True)
class Area:
    """The part of a film that is rendered, in pixels.

    width, height   with the border that a reconstruction filter may ask for
    size, offset    of the crop window
    border          pixels on each side beyond it
    box             whether the filter is a box: then the samples of a pixel are added up, else each is put on the film
    radius          of the filter
    """

    width: int
    height: int
    size: tuple[int, int]
    offset: tuple[int, int]
    border: int
    box: bool
    radius: float = 0.5

    @classmethod
    def of(cls, sensor) -> Area:
        film = sensor.film()
        border = film.rfilter().border_size() if film.sample_border() else 0
        size, offset = (tuple(int(v) for v in vector) for vector in (film.crop_size(), film.crop_offset()))
        width, height = (v + 2 * border for v in size)
        rfilter = film.rfilter()
        return cls(width, height, size, offset, border, rfilter.is_box_filter(), float(rfilter.radius()))

    @property
    def n_pixels(self) -> int:
        return self.width * self.height

    def corner(self, pixel):
        """Corner of a pixel, in pixels of the crop window."""
        return mi.Point2f(mi.Float(pixel % self.width) - self.border, mi.Float(pixel // self.width) - self.border)

    def reaches(self, place):
        """Whether a sample at `place`, in pixels of the crop window, reaches a pixel. In a border there are some that
        reach none; for them Mitsuba 3.9.1 writes beside the image, which ends the process (``lanczos``)."""
        low, high = 0.5 - self.radius, mi.Vector2f(mi.ScalarVector2f(self.size)) - 0.5 + self.radius
        return dr.all((place > low) & (place < high)) if self.border else mi.Bool(True)


def put_in_reach(area: Area, place, values: list) -> tuple:
    """Samples (place in pixels of the crop window, values) as they may be put on a film: those that reach no pixel are
    nothing, in the first pixel."""
    if not area.border:
        return place, values
    reaches = area.reaches(place)
    return dr.select(reaches, place, mi.Point2f(0.5)), [dr.select(reaches, v, 0) for v in values]


def camera_rays(sensor, area: Area, pixel, sampler) -> tuple:
    """Rays through random places of pixels: (ray, weight, place in pixels of the crop window, sampler)."""
    place = area.corner(pixel) + sampler.stratified_2d(0)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    unit = place / mi.Vector2f(mi.ScalarVector2f(area.size))
    ray, weight = sensor.sample_ray_differential(time, sampler.next_1d(), unit, aperture)
    return ray, weight, place, sampler


def sensor_of(scene, sensor, who: str):
    """The sensor of that number, or the sensor given. Raises ValueError, beginning with `who`, where there is none."""
    if isinstance(sensor, mi.Sensor):
        return sensor
    if not hasattr(sensor, "__index__"):
        raise ValueError(f"{who}: sensor is {sensor!r}; give its number in the scene, or a sensor")
    if not scene.sensors():
        raise ValueError(
            f"{who}: the scene has no sensor; add one, for example <sensor type=\"perspective\"/>, or give one to "
            "mi.render(scene, sensor=...)"
        )
    if not 0 <= sensor < len(scene.sensors()):
        raise ValueError(f"{who}: there is no sensor {sensor}; the scene has {len(scene.sensors())}")
    return scene.sensors()[sensor]


def film_rays(sensor, place, sampler) -> mi.Ray3f:
    """Rays through `place`, in [0, 1]² of the film; time and aperture are drawn from `sampler`."""
    time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    sample = sensor.sample_ray_differential  # all of Mitsuba's sensors have it; some have no sample_ray()
    ray, _ = sample(time, sampler.next_1d(), mi.Point2f(place), sampler.next_2d())
    return mi.Ray3f(ray)


#: Rays along a side of the film that stand for a sensor which cannot be recorded.
SIDE = 256


class RaySensor:
    """Rays in the place of the sensor that they came from. A PyTree.

    It stands for sensors that Dr.Jit cannot record, and for the unknown sensor of an integrator that is wrapped by
    another: that of the rays it is called with. A ray is chosen by the place on the film, as far as that is known: of
    `side` x `side` rays the nearest, else any. `medium`: what the sensor is in, if it is known.
    """

    DRJIT_STRUCT = {"o": object, "d": object, "time": object}  # noqa: RUF012
    side, medium = 0, None

    def __init__(self, ray=None, side: int = 0, medium=None):
        if ray is None:  # as Dr.Jit makes one
            return
        self.medium = medium
        zero = dr.zeros(mi.Float, dr.width(ray))
        self.side = side
        self.o, self.d = mi.Point3f(dr.detach(ray.o)) + zero, mi.Vector3f(dr.detach(ray.d)) + zero
        self.time = mi.Float(dr.detach(ray.time)) + zero
        dr.eval(self.o, self.d, self.time)

    @classmethod
    def of(cls, sensor, seed: int) -> RaySensor:
        """Rays of `sensor`, spread evenly over its film."""
        lane, seed = dr.arange(mi.UInt32, SIDE * SIDE), dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        sampler = PathSampler.make(lane, seed)
        place = mi.Point2f(mi.Float(lane % SIDE), mi.Float(lane // SIDE)) + sampler.next_2d()
        return cls(film_rays(sensor, place / SIDE, sampler), SIDE, sensor.get_medium())

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        n, side = dr.width(self.time), self.side
        if side:
            x, y = (mi.UInt32(dr.clip(v * side, 0, side - 1)) for v in (sample2.x, sample2.y))
            index = y * side + x
        else:
            index = dr.minimum(mi.UInt32(sample2.x * n), n - 1)
        ray = mi.Ray3f(dr.gather(mi.Point3f, self.o, index), dr.gather(mi.Vector3f, self.d, index))
        ray.time = dr.gather(mi.Float, self.time, index)
        return ray, mi.Spectrum(1)

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def class_name(self):
        return "RaySensor"

    def get_medium(self):
        return self.medium

    def shutter_open(self):
        return 0.0

    def shutter_open_time(self):
        return 0.0

    def needs_aperture_sample(self):
        return False


def recordable(sensor, seed: int, scene_records: bool = True):
    """`sensor`, or rays of it where it, or its scene, cannot be part of a recorded function. Another `seed` gives other
    rays."""
    return sensor if scene_records and can_freeze(sensor) else RaySensor.of(sensor, seed)


@dataclass
class Samples:
    """Which camera samples a pass renders; numbers as variables, so that one kernel serves all sizes. A PyTree.

    `seed` is that of the independent random numbers, `sequence` that of the stratified ones: passes of one image that
    have it in common go on where the one before ended, at `first_sample`. `n_image`: samples a pixel of the image, of
    which this pass has `n_samples`.
    """

    seed: mi.UInt32
    sequence: mi.UInt32
    first_sample: mi.UInt32
    n_samples: mi.UInt32
    first_row: mi.UInt32
    n_rows: mi.UInt32
    n_image: mi.UInt32

    def lanes(self, area: Area, n_lanes: int) -> tuple:
        """(pixel, number of the sample in its pixel, active) for each lane.

        A packet of lanes holds one sample each of `PACKET` neighbouring pixels, the next packet the next samples of the
        same: so lanes that run together may decide together (:meth:`PathSampler.together_1d`), and pixels stay
        independent of one another in all their samples but that.
        """
        lane = dr.arange(mi.UInt32, n_lanes)
        packet = lane // PACKET
        local = packet // self.n_samples * PACKET + lane % PACKET
        return (local + self.first_row * area.width, packet % self.n_samples + self.first_sample,
                local < area.width * self.n_rows)  # fmt: skip

    def scale_differentials(self, ray) -> None:
        """Make the differentials of camera rays as narrow as the image's samples of a pixel lie, as Mitsuba does."""
        ray.scale_differential(dr.rsqrt(mi.Float(self.n_image)))

    def sampler(self, pixel, sample, salt: int) -> PathSampler:
        """Random numbers of these samples; another `salt` gives other independent ones, the same stratified ones."""
        scramble, _ = mi.sample_tea_32(pixel, self.sequence, 4)
        group, _ = mi.sample_tea_32(pixel // PACKET, self.sequence ^ 0x2545F491, 4)
        lane = pixel + sample * mi.UInt32(0x9E3779B9)
        return PathSampler.make(lane, self.seed ^ salt, sample, scramble, group)


def coverage(valid):
    """Share of a sample that covers its pixel, from a mask or from that share."""
    return dr.select(valid, mi.Float(1), 0) if dr.is_mask_v(valid) else mi.Float(valid)


def _sums(values: list, first, stride: int, count) -> list:
    """Sums over the `count` entries ``first + k stride`` of each array."""
    zeros = [dr.zeros(mi.Float, dr.width(first)) for _ in values]

    def add(k, totals):
        return k + 1, [s + dr.gather(mi.Float, v, first + k * stride) for s, v in zip(totals, values, strict=True)]

    return dr.while_loop((mi.UInt32(0), zeros), lambda k, _: k < count, add, label="samples of a pixel")[1]


class Passes:
    """Renders camera samples by recorded functions, each traced once and then replayed.

    ``estimate(scene, lights, field, sampler, ray, settings, active)`` gives (L, coverage or mask, {channel: value}).
    One recording serves all sensors of a kind; `clear` forgets them, which would keep what they were made for.
    """

    def __init__(self):
        self.recorded: dict[tuple, Callable] = {}

    def clear(self) -> None:
        self.recorded.clear()

    def run(self, estimate, channels: dict[str, int], keys: tuple, scene, sensor, lights, field, samples: Samples,
            sizes: tuple[int, int], settings, record: bool = True, sums: bool = False) -> tuple:  # fmt: skip
        """Render `samples` of ``sizes = (rows, samples a pixel)``: (places, values for the film's block, number of
        samples that were not finite). `channels`: values of each, by name; `keys`: what `estimate` depends on."""
        area, film = Area.of(sensor), sensor.film()
        if sums:  # as with a box filter
            area = replace(area, box=True)
        alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        special = film if is_special(sensor) else None
        record = record and special is None
        n_pixels = area.width * sizes[0]
        n_lanes = -(-n_pixels // PACKET) * PACKET * sizes[1]
        offset = dr.opaque(mi.Point2f, [float(v) for v in area.offset])
        direct = record and can_freeze(sensor)
        rays = None
        if record and not direct:
            pixel, sample, _ = samples.lanes(area, n_lanes)
            rays = camera_rays(sensor, area, pixel, samples.sampler(pixel, sample, 0x6A09E667))[:3]
            dr.eval(rays)
        key = (kind_of(sensor) if direct else "", area.width, area.size, area.border, area.box, alpha, sizes,
               tuple(channels), keys, record)  # fmt: skip
        plain = _pass_of(estimate, dict(channels), area, alpha, n_pixels, n_lanes, special)
        arguments = scene, sensor if rays is None else None, rays, lights, field, samples, offset, settings
        if record and key not in self.recorded:
            self.recorded[key] = dr.freeze(plain, auto_opaque=False)
        return call(self.recorded, key, plain, *arguments)


def kind_of(sensor) -> tuple:
    """What a recorded function takes for granted of a sensor."""
    return sensor.class_name(), bool(sensor.needs_aperture_sample()), sensor.shutter_open_time() > 0


def _pass_of(estimate, channels: dict[str, int], area: Area, alpha: bool, n_pixels: int, n_lanes: int,
             special=None) -> Callable:  # fmt: skip
    """A function that renders one pass, to be recorded. `special`: a film that makes its own channels of a sample."""

    def render_pass(scene, sensor, rays, lights, field, samples, offset, settings):
        pixel, sample, active = samples.lanes(area, n_lanes)
        sampler = samples.sampler(pixel, sample, 0x5BF03635)
        if rays is None:
            ray, weight, place, sampler = camera_rays(sensor, area, pixel, sampler)
        else:
            ray, weight, place = rays
        samples.scale_differentials(ray)

        L, valid, extra = estimate(scene, lights, field, sampler, ray, settings, active)
        L = L * weight if special is not None else film_colour(L * weight, ray.wavelengths, active)
        ok = dr.all(dr.isfinite(L))
        # A sample that is not finite counts nowhere, in alpha and channels neither
        L, one = dr.select(ok, L, 0), dr.select(ok & active, mi.Float(1), 0)
        if special is not None:
            n_channels = special.create_block().channel_count()
            values = special.prepare_sample(L, ray.wavelengths, n_channels, one, coverage(valid), active)
        else:
            values = [L.x, L.y, L.z, *([coverage(valid)] if alpha else []), one]
        for name, size in channels.items():
            value = dr.select(ok, extra[name], 0)
            values += [*value] if size == 3 else [mi.Float(value)]
        dr.eval(values, ok)  # one kernel; the sums below would otherwise run the whole estimate again, each
        if alpha and special is None:  # here: inside of that kernel it would cost nirc 8 % (Cornell box, 128x128)
            values[3] = dr.select(ok, values[3], 0)
        n_bad = dr.count(~ok & active)
        if area.box:  # one value a pixel, the sum of its samples
            local = dr.arange(mi.UInt32, n_pixels)
            n = samples.n_samples
            values = _sums(values, local // PACKET * PACKET * n + local % PACKET, PACKET, n)
            place = area.corner(local + samples.first_row * area.width) + 0.5
        place, values = put_in_reach(area, place, values)
        place = place + offset
        dr.eval(place, values, n_bad)
        return place, values, n_bad

    return render_pass
