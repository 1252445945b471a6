"""``plain_path``: the shortest correct path tracer."""

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi

from mi_neural.integrators.checks import check_gradients_in_media, wants_gradients
from mi_neural.integrators.keys import LIGHT_SAMPLER_KEY, register
from mi_neural.integrators.lighting import LightSamplingIntegrator, differentiates
from mi_neural.lights.unshadowed import UnshadowedLights
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.spectrum import is_rgb


class PlainPathIntegrator(LightSamplingIntegrator):
    __doc__ = (
        r"""
    .. _integrator-plain_path:

    Plain path tracer (:monosp:`plain_path`)
    ----------------------------------------

    Estimates the rendering equation without bias, and is written to be read: the ground truth beside the cached
    integrators, and the place to start from when writing one of your own. Each vertex adds

    .. math:: \beta \left( w_b L_e + w_e f L_e \cos\theta / p_e \right),

    emission met by the BSDF ray and next-event estimation, weighted against each other (Veach 1997, eq. 9.13).

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path in segments: 1 shows emitters, 2 adds direct light; -1 means no limit. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth from which Russian roulette may end a path. (Default: 5)
     * - hide_emitters
       - |bool|
       - Leave out what the camera sees of emitters directly. (Default: false)
    """
        + LIGHT_SAMPLER_KEY.rstrip()
        + r"""
     * - neural_depth
       - |int|
       - From this vertex on (0: the first surface) direct light is what the nested ``nvc_lights`` predicts, which must
         know lights one by one: no shadow ray, no noise, but a bias, as in ``nvc_direct`` with ``mode=neural``. -1:
         nowhere. (Default: -1)

    In participating media vertices are points where a medium scatters, too: the phase function stands in the place of
    the BSDF. Distances are sampled by delta tracking; with extinctions that differ between colours, all of them are
    weighted against each other (Miller et al. 2019). Transmittance along shadow rays is exact in homogeneous media, and
    estimated by ratio tracking in others (Novák et al. 2014). ``rr_depth`` counts as in ``volpath`` there.

    *Works with* all surfaces, emitters and media of Mitsuba, in RGB, mono and spectral variants. *Leaves out*
    polarization, phase functions of microflakes (``sggx``: use ``volpath``), and in media gradients (use
    ``prbvolpath``) and ``neural_depth``.

    .. tabs::
        .. code-tab:: xml

            <integrator type="plain_path"> <integer name="max_depth" value="8"/> </integrator>

        .. code-tab:: python

            mi.load_dict({"type": "plain_path", "max_depth": 8})
    """
    )

    renders_media = True

    def __init__(self, props):
        super().__init__(props)
        self.neural_depth = props.get("neural_depth", -1)
        self.records = self.neural_depth < 0
        self.unshadowed: UnshadowedLights | None = None
        if self.neural_depth >= 0 and not is_rgb():
            raise ValueError("plain_path: neural_depth works in RGB variants alone; leave it out")
        if self.neural_depth < -1:
            raise ValueError(f"plain_path: neural_depth is {self.neural_depth}; give -1 (nowhere), 0, or more")
        if self.neural_depth >= 0 and not getattr(self.light_sampler, "visibility", False):
            raise ValueError("plain_path: neural_depth needs an nvc_lights with visibility=true as light_sampler")

    def bind(self, scene, sensor, train: bool = True) -> None:
        super().bind(scene, sensor, train)
        self.bind_media(scene, sensor, self.bound)
        if self.media is not None and self.neural_depth >= 0:
            raise ValueError("plain_path: neural_depth works in scenes without participating media; leave it out")
        if self.neural_depth < 0 or self.lights is None:  # a single light is traced as ever
            self.unshadowed = None
            return
        lights = self.lights
        if not lights.groups.single:
            raise ValueError(
                f"plain_path: neural_depth must know each light by itself, and there are {lights.table.n_lights} for "
                f"{lights.groups.n_groups} outputs; raise outputs of the light_sampler (up to 256), with "
                "environment_cells=0"
            )
        with dr.suspend_grad():
            if self.unshadowed is None or self.unshadowed.table is not lights.table:
                self.unshadowed = UnshadowedLights(scene, lights.table)
            else:
                self.unshadowed.refresh()

    def check_gradients(self, scene) -> None:
        if self.media is not None:
            check_gradients_in_media(scene, self.plugin)
        if self.neural_depth >= 0 and wants_gradients(scene):
            raise RuntimeError("plain_path: predicted direct light has no gradients; leave neural_depth out")
        super().check_gradients(scene)

    def direct(self, scene, lights, path, bsdf, found, numbers, sampler, alone=None):
        """As `paths.direct_light`; from `neural_depth` on as it is predicted, and what mirrors show."""
        predicted = path.active & (path.depth > self.neural_depth)
        traced = replace(path, active=path.active & ~predicted)
        found = replace(found, followed=found.followed & (~predicted | found.delta))
        L, Le, sampler = paths.direct_light(scene, lights, traced, bsdf, found, numbers, sampler)
        predicted &= vertex.has_smooth(bsdf)
        L += self.unshadowed.total(scene, path.si, bsdf, lights.field.query(path.si.p), predicted)
        return L, Le, sampler

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = Le + ∫ f L cos dω, at each vertex direct light plus the rest of the path."""
        if self.media is not None:
            return self.estimate_media(scene, lights, sampler, mi.Ray3f(dr.detach(ray)), active)
        limit = self.depth_limit
        direct = self.direct if self.unshadowed is not None else None
        if direct is None and lights is not None and self.film_state.entered and differentiates():
            direct = partial(paths.direct_light, attached=True)  # the table of lights has no derivatives

        def step(path, sampler):
            found, sampler = paths.bounce(scene, lights, path, sampler, direct=direct)
            path = paths.advance(path, found, limit)
            return paths.roulette(path, sampler, self.rr_depth)

        path = paths.camera_vertex(self, scene, mi.Ray3f(dr.detach(ray)), active)
        path, sampler = dr.while_loop((path, sampler), lambda path, sampler: path.active, step, label="path")
        return path.L, path.valid, {}

    def estimate_media(self, scene, lights, sampler, ray, active):
        """As `estimate`, where there are media: vertices are surfaces, and points at which a medium scatters."""
        media = self.media

        def step(path, sampler):
            numbers, sampler = paths.draw_numbers(sampler)
            if not media.partial:  # elsewhere a path may stay at its first vertex for some steps
                numbers = dr.select(path.depth == 1, numbers_first, numbers)
            found, sampler = media.bounce(self, scene, lights, path, sampler, numbers)
            path = media.advance(self, path, found)
            return paths.roulette(path, sampler, self.rr_depth + 1)  # volpath's begins one bounce later

        path, sampler = media.camera_vertex(self, scene, ray, self.camera_medium, sampler, active)
        numbers_first = paths.stratified(sampler)
        path, sampler = dr.while_loop((path, sampler), lambda path, sampler: path.active, step, label="path")
        return path.L, path.valid, {}

    def to_string(self):
        return f"PlainPathIntegrator[max_depth={self.max_depth}, rr_depth={self.rr_depth}]"


register("plain_path", PlainPathIntegrator)
