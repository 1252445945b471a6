"""``plain_path``: the shortest correct path tracer."""

import drjit as dr
import mitsuba as mi

from mi_neural.transport import vertex


class PlainPathIntegrator(mi.SamplingIntegrator):
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

    *Works with* all surfaces and emitters of Mitsuba. *Leaves out* participating media (use ``volpath``), polarization.

    .. tabs::
        .. code-tab:: xml

            <integrator type="plain_path"> <integer name="max_depth" value="8"/> </integrator>

        .. code-tab:: python

            mi.load_dict({"type": "plain_path", "max_depth": 8})
    """

    def __init__(self, props):
        super().__init__(props)
        self.max_depth = props.get("max_depth", -1)
        self.rr_depth = props.get("rr_depth", 5)
        self.hide = props.get("hide_emitters", False)
        if self.max_depth < -1:
            raise ValueError(f"plain_path: max_depth is {self.max_depth}; give -1 (no limit), 0, or a positive number")
        if self.rr_depth < 1:
            raise ValueError(f"plain_path: rr_depth is {self.rr_depth}; it must be at least 1")

    @dr.syntax
    def sample(self, scene, sampler, ray, medium=None, active=True):
        max_depth = mi.UInt32(self.max_depth if self.max_depth >= 0 else 0xFFFFFFFF)
        bsdf_ctx = mi.BSDFContext()
        hide = mi.Bool(self.hide)

        ray = mi.Ray3f(dr.detach(ray))
        L = mi.Spectrum(0)  # Radiance so far
        β = mi.Spectrum(1)  # Throughput
        η = mi.Float(1)  # Relative index of refraction along the path
        depth = mi.UInt32(0)
        p_prev, n_prev = mi.Point3f(ray.o), mi.Normal3f(0, 0, 1)  # Where the ray comes from,
        pdf_prev, delta_prev = mi.Float(1), mi.Bool(True)  # and how it was sampled
        active = mi.Bool(active) & (max_depth > 0)
        valid = mi.Bool(False)

        while active:
            pi = scene.ray_intersect_preliminary(ray, active=active)
            if dr.hint(self.hide, mode="scalar"):  # look through emitters that the camera sees
                first = active & (depth == 0)
                pi = dr.select(first, self.skip_area_emitters(scene, ray, True, first), pi)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            seen = (depth > 0) | ~hide
            L += β * vertex.emission_mis(scene, si, p_prev, n_prev, pdf_prev, delta_prev, active & seen)
            valid |= active & seen & (si.is_valid() | (si.emitter(scene, active) != None))  # noqa: E711
            active &= si.is_valid() & (depth + 1 < max_depth)

            # Direct light by next-event estimation
            bsdf = si.bsdf(ray)
            smooth = active & vertex.has_smooth(bsdf)
            L += β * vertex.direct_light(scene, si, bsdf, sampler.next_2d(), smooth)

            # Go on in a direction that the BSDF chooses
            bs, weight = bsdf.sample(bsdf_ctx, si, sampler.next_1d(), sampler.next_2d(), active)
            β = vertex.finite(β * weight, active)
            η *= bs.eta
            p_prev, n_prev = mi.Point3f(si.p), mi.Normal3f(si.n)
            pdf_prev, delta_prev = mi.Float(bs.pdf), mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            ray = si.spawn_ray(si.to_world(bs.wo))
            depth += 1

            # Russian roulette (must cancel out η² to obtain unitless throughput)
            q = dr.minimum(dr.max(β) * η**2, 0.95)
            roulette = depth >= self.rr_depth
            active &= (dr.max(β) > 0) & (~roulette | (sampler.next_1d() < q))
            β[roulette] *= dr.rcp(dr.maximum(q, 1e-6))

        return L, valid, []

    def to_string(self):
        return f"PlainPathIntegrator[max_depth={self.max_depth}, rr_depth={self.rr_depth}]"


mi.register_integrator("plain_path", lambda props: PlainPathIntegrator(props))
