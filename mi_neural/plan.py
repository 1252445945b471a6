"""What a scene needs: facts read off it, and of each part of an estimator whether it is modelled, or left out, and why.

A plan is made once per scene by whoever renders it. Its decisions follow from what cannot change while the scene is
the same: kinds and numbers of emitters, flags of BSDFs. Where lights are to be chosen it also looks: some thousand
shadow rays say what each way of choosing them would leave of the noise (:mod:`.light_noise`). A decision that a key has
fixed is `given`. In the mode ``everything`` all parts are built that can be, for comparison.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from . import parameters
from .caches.outgoing_field import INPUTS
from .light_noise import MOST_OUTPUTS, LightNoise
from .lights.entries import is_emissive_mesh
from .lights.inexact import inexact
from .render.media import media_of

MODES = ("scene", "everything")
#: Learned visibility is worth its time where it leaves less than this share of the noise of a choice by power. Shares,
#: and what was gained in equal time: 0.01 (32 lamps) 5 times, 0.1 (24,576 triangles) 13 times, 0.19 (staircase of 13
#: lights, frames 1.6 times as long) nothing. And power is worth its own code where it leaves less than the second.
WORTH_SHARE, WORTH_POWER = 0.15, 0.8
#: More lights than this are not looked at: a table of them would take seconds and gigabytes unasked.
MOST_LOOKED_AT = 2**18
#: Noise of direct light from which on 2, and 4, samples of it are taken per camera sample.
TWO_SAMPLES, FOUR_SAMPLES = 0.02, 0.08
#: Parts of an environment with an output each, where everything is built.
EVERY_CELL = 32

#: Parameters that are a roughness, as a number, a constant spectrum, or the values of a bitmap or grid.
ROUGHNESS = re.compile(r"(^|\.)(alpha|alpha_u|alpha_v|roughness)(\.value|\.data|\.volume\.data)?$")


@dataclass(frozen=True)
class SceneFacts:
    """What can be read off a scene without tracing a ray.

    emitters      number of them by kind: area, environment, directional, point (all others without extent)
    triangles     primitives of emissive meshes
    lights        what a light sampler chooses among; an emissive mesh of two triangles counts as one light
    surfaces      shapes by what they reflect: lambertian (diffuse alone), glossy, mixed (diffuse with a mirror or with
                  holes), mirror (no smooth lobe), unknown (instances, whose materials Mitsuba does not give)
    textures      shapes with a textured BSDF
    roughness     least and largest alpha of BSDFs that have one, textures of it included; None without
    film          (width, height) in pixels; None without a sensor
    extent        longest side of the scene's box, in its unit; None where that is not finite
    sensors       their number
    media         whether there are participating media
    unknown_roughness   glossy shapes whose alpha cannot be read: measured materials, procedural textures, hair
    inexact       emitters that Mitsuba itself does not sample exactly, by what keeps it (:mod:`.lights.inexact`)
    """

    emitters: dict[str, int]
    triangles: int
    lights: int
    surfaces: dict[str, int]
    textures: int
    roughness: tuple[float, float] | None
    film: tuple[int, int] | None
    extent: float | None
    sensors: int
    media: bool
    unknown_roughness: int = 0
    inexact: dict[str, int] = field(default_factory=dict)

    @classmethod
    def read(cls, scene, sensor) -> SceneFacts:
        emitters, triangles, lights, wrong = {}, 0, 0, {}
        for emitter in scene.emitters():
            if why := inexact(emitter):
                wrong[why] = wrong.get(why, 0) + 1
            kind, primitives = _kind(emitter)
            emitters[kind] = emitters.get(kind, 0) + 1
            triangles += primitives
            lights += primitives if primitives > 2 else 1
        surfaces, textures, alphas, unknown, materials = {}, 0, [], 0, {}
        for shape in scene.shapes():
            bsdf = shape.bsdf()
            if bsdf is None:
                continue
            if shape.class_name() == "Instance":  # its own BSDF is a default one
                kind, textured, found = "unknown", False, []
            else:
                if bsdf.ptr not in materials:
                    materials[bsdf.ptr] = _material(bsdf)
                kind, textured, found = materials[bsdf.ptr]
            surfaces[kind] = surfaces.get(kind, 0) + 1
            textures += textured
            alphas += found
            unknown += kind in ("glossy", "unknown") and not found
        box = np.array(scene.bbox().extents(), np.float64).ravel()
        return cls(
            emitters, triangles, lights, surfaces, textures, (min(alphas), max(alphas)) if alphas else None,
            None if not hasattr(sensor, "film") else tuple(int(n) for n in sensor.film().crop_size()),
            float(box.max()) if np.isfinite(box).all() else None,
            len(scene.sensors()), bool(media_of(scene, [sensor])), unknown, wrong,
        )  # fmt: skip

    @property
    def why_exact(self) -> str:
        """Why lights are sampled by a light sampler whatever their number; empty where there is no reason."""
        parts = [f"{n} x {why}" if n > 1 else why for why, n in self.inexact.items()]
        return f"Mitsuba's own sampling of {', '.join(parts)} is not exact" if parts else ""

    @property
    def environment(self) -> bool:
        return "environment" in self.emitters

    @property
    def smooth(self) -> int:
        """Shapes that a cache can be asked at."""
        return sum(n for kind, n in self.surfaces.items() if kind != "mirror")

    @property
    def alike(self) -> bool:
        """Whether every surface, mirrors apart, reflects the same in all directions."""
        return self.smooth == self.surfaces.get("lambertian", 0)


def _kind(emitter) -> tuple[str, int]:
    """Kind of an emitter, and the primitives of its mesh, if each of them is a light (else 0)."""
    if emitter.is_environment():
        return "environment", 0
    shape = emitter.get_shape()
    if shape is not None:
        return "area", int(shape.primitive_count()) if is_emissive_mesh(emitter) else 0
    if int(emitter.flags()) & int(mi.EmitterFlags.DeltaDirection):
        return "directional", 0
    return "point", 0


def _reflects(bsdf) -> str:
    flags, names = int(bsdf.flags()), mi.BSDFFlags
    if not flags & int(names.Smooth):
        return "mirror"
    if flags & int(names.Glossy):
        return "glossy"
    return "mixed" if flags & int(names.Delta) else "lambertian"


def _material(bsdf) -> tuple[str, bool, list[float]]:
    """What a BSDF reflects, whether it is textured, and least and largest alpha, as far as they can be read."""
    if bsdf.class_name() == "SmoothDiffuse":  # without a look at its parts, as each of ten thousand lamps may have one
        return _reflects(bsdf), bool(int(bsdf.flags()) & int(mi.BSDFFlags.SpatiallyVarying)), []
    params = parameters.traverse(bsdf)
    textures = [node for node in params.hierarchy if isinstance(node, mi.Texture)]
    # A MeshAttribute says that it does not vary
    textured = any(node.is_spatially_varying() or node.class_name() == "MeshAttribute" for node in textures)
    alphas = []
    for key in params.keys():
        found = ROUGHNESS.search(key)
        if found is None or (found[2] == "roughness" and _owner(params, key) not in ("Principled", "PrincipledThin")):
            continue
        value = params[key]
        if isinstance(value, (int, float)) or (dr.is_array_v(value) and dr.is_float_v(value)):
            values = np.array(value, np.float64).ravel()
            values = values[np.isfinite(values)] ** (2 if found[2] == "roughness" else 1)
            alphas += [float(v) for v in (values.min(), values.max())] if values.size else []
    return _reflects(bsdf), textured, [min(alphas), max(alphas)] if alphas else []


def _owner(params, key: str) -> str:
    """Class of the BSDF that a parameter belongs to, by way of a texture or not."""
    node = params.properties[key][2]
    while isinstance(node, (mi.Texture, mi.Volume)):
        node = params.hierarchy[node][0]
    return node.class_name() if node is not None else ""


# ---------------------------------------------------------------------------------------------------------------------
# Decisions


@dataclass(frozen=True)
class Decision:
    """What becomes of one part.

    value      what is built: a name, a number, True; False or 0 where nothing is
    modelled   whether it is built at all
    because    the reason, with the facts in numbers
    given      whether a key has fixed it
    """

    value: object
    modelled: bool
    because: str
    given: bool = False

    def __str__(self):
        what = "modelled" if self.modelled else "left out"
        if self.modelled and not isinstance(self.value, bool):
            what += f": {self.value}"
        return what + (" (given)" if self.given else "")


def modelled(value, because: str) -> Decision:
    return Decision(value, True, because)


def left_out(because: str) -> Decision:
    return Decision(False, False, because)


def given(value, because: str) -> Decision:
    return Decision(value, bool(value), because, True)


@dataclass(frozen=True)
class Request:
    """What an integrator, or a light sampler, asks a plan for.

    plugin      its name
    mode        one of `MODES`
    given       decisions that keys have fixed, by part
    caches      of integrators, what they may ask for light: any of ``incident``, ``outgoing``
    max_depth   of their paths, in segments; -1: no limit
    blend       see :mod:`.caches.blend`
    sizes       of the network by default, by part
    look        gives the :class:`LightNoise` of the scene; None: lights are chosen by the scene, or as given
    """

    plugin: str
    mode: str = "scene"
    given: dict[str, object] = field(default_factory=dict)
    caches: tuple[str, ...] = ()
    max_depth: int = -1
    blend: str = "ema"
    sizes: dict[str, int] = field(default_factory=dict)
    look: Callable[[], LightNoise] | None = None

    @property
    def everything(self) -> bool:
        return self.mode == "everything"


@dataclass
class ScenePlan:
    """Facts, and decisions by part. ``plan["clusters"]`` is the value of one; ``print(plan)`` says them all."""

    plugin: str
    mode: str
    facts: SceneFacts
    decisions: dict[str, Decision] = field(default_factory=dict)

    def __getitem__(self, part: str):
        return self.decisions[part].value if part in self.decisions else False

    def modelled(self, part: str) -> bool:
        """Whether a part is built; one that the plan does not speak of is not."""
        return part in self.decisions and self.decisions[part].modelled

    def to_json(self) -> dict:
        """Plain values."""
        facts = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self.facts).items()}
        parts = {part: asdict(d) for part, d in self.decisions.items()}
        return {"plugin": self.plugin, "mode": self.mode, "facts": facts, "decisions": parts}

    def rows(self) -> list[tuple[str, str, str]]:
        """(part, what becomes of it, why) of each decision, as text."""
        return [(part, str(d), d.because) for part, d in self.decisions.items()]

    def __str__(self):
        rows = self.rows()
        wide = [max((len(r[k]) for r in rows), default=0) for k in (0, 1)]
        lines = [f"    {part:{wide[0]}}  {what:{wide[1]}}  {why}" for part, what, why in rows]
        return "\n".join([f"ScenePlan[{self.plugin}, {self.mode}", *lines, "  ]"])


def of_integrator(facts: SceneFacts, request: Request) -> ScenePlan:
    """What an integrator with caches builds in a scene; the parts of its light sampler are in that one's plan."""
    plan = ScenePlan(request.plugin, request.mode, facts)
    plan.decisions["cache"] = _cache(facts, request)
    plan.decisions["light_sampler"] = _light_sampler(facts, request)
    if "light_samples" in request.given:
        plan.decisions["light_samples"] = given(request.given["light_samples"], "else by the noise of direct light")
    if not plan.modelled("cache"):
        return plan
    plan.decisions["reliability"] = _reliability(request)
    if "outgoing" in request.caches:
        for name in INPUTS:
            decision = _input(name, facts, request)
            if name in request.given:
                decision = given(request.given[name], f"else {decision}: {decision.because}")
            plan.decisions[name] = decision
    for name, size in request.sizes.items():
        plan.decisions[name] = modelled(size, "the same in all scenes (mi-neural doc measured)")
        if name in request.given:
            plan.decisions[name] = given(request.given[name], f"else {size}")
    return plan


def of_sampler(facts: SceneFacts, request: Request) -> ScenePlan:
    """What a light sampler builds in a scene."""
    plan = ScenePlan(request.plugin, request.mode, facts)
    by_visibility, n = request.plugin == "nvc_lights", facts.lights
    cells = request.given.get("environment_cells", 0)
    if n > 1 or request.everything:
        plan.decisions["light_sampler"] = modelled(request.plugin, f"lights: {n}")
    elif cells and facts.environment:
        plan.decisions["light_sampler"] = modelled(request.plugin, f"parts of the environment: {cells}")
    elif facts.inexact:
        plan.decisions["light_sampler"] = modelled(request.plugin, facts.why_exact)
    else:
        plan.decisions["light_sampler"] = left_out(f"nothing to choose, lights: {n}")
    if not by_visibility or not plan.modelled("light_sampler"):
        return plan

    most = request.given.get("outputs", MOST_OUTPUTS)
    clustered = n > most
    if not request.given.get("visibility", True):
        plan.decisions["visibility"] = given(False, "lights are chosen by what they would give without shadows")
    else:
        each = f"{n} lights in at most {most} clusters" if clustered else f"an output for each light: {n}"
        plan.decisions["visibility"] = modelled(min(n, most), each)
    if not clustered:
        plan.decisions["clusters"] = left_out(f"each light has an output, lights: {n}, outputs: up to {most}")
    elif "clusters" in request.given:
        plan.decisions["clusters"] = given(request.given["clusters"], f"{n} lights, {most} outputs")
    else:
        plan.decisions["clusters"] = modelled("auto", f"{n} lights, {most} outputs")
    plan.decisions["environment_cells"] = _environment(facts, request)
    return plan


def _cache(facts: SceneFacts, request: Request) -> Decision:
    n, known = sum(facts.surfaces.values()), request.given.get("cache", "network")
    if 0 <= request.max_depth <= 2:
        return left_out(f"paths of at most {request.max_depth} segments meet no light that was reflected before")
    if not known:
        return given(False, "a path tracer")
    if not (facts.smooth or facts.media or request.everything):
        return left_out(f"all of {n} surfaces are mirrors or glass")
    why = f"{facts.smooth} of {n} surfaces are neither mirrors nor glass"
    if facts.media:
        why += ", and media scatter"
    return given(known, why) if "cache" in request.given else modelled(known, why)


def _light_sampler(facts: SceneFacts, request: Request) -> Decision:
    n = facts.lights
    if request.everything:
        return modelled(request.given.get("light_sampler", "nvc_lights"), f"everything; lights: {n}")
    if "light_sampler" in request.given:
        return given(request.given["light_sampler"], f"lights: {n}")
    exact = facts.why_exact
    if n < 2:
        return modelled("uniform_lights", exact) if exact else left_out(f"nothing to choose, lights: {n}")
    if request.look is None or n > MOST_LOOKED_AT:
        if exact and n <= MOST_LOOKED_AT:
            return modelled("power_lights", exact)
        own = f"the scene's own choice among {n} lights; nest one to have another"
        return left_out(f"{own}: {exact}" if exact else own)
    noise = request.look()
    figures = f"variance of direct light, {n} lights: {noise}"
    if noise.visibility < WORTH_SHARE * min(noise.power, noise.uniform):
        return modelled("nvc_lights", figures)
    if noise.power < WORTH_POWER * noise.uniform:
        return modelled("power_lights", f"{figures}; visibility would take the time that it saves")
    if exact:
        return modelled("power_lights" if noise.power < noise.uniform else "uniform_lights", f"{figures}; {exact}")
    return left_out(f"{figures}; the uniform choice of the scene is kept")


def _environment(facts: SceneFacts, request: Request) -> Decision:
    if not facts.environment:
        return left_out("there is no environment")
    cells = request.given.get("environment_cells")
    if cells is not None:
        return given(cells, "there is an environment")
    if request.everything:
        return modelled(EVERY_CELL, "everything; there is an environment")
    return left_out("visibility by direction takes the time that it saves (mi-neural doc measured)")


def _reliability(request: Request) -> Decision:
    if request.blend in ("reliability", "switch"):
        return modelled(True, f"blend is {request.blend}: two sets of weights, compared by place")
    if request.blend == "control":
        return modelled("alpha", "the cache is a control variate: its coefficient is measured by place")
    return left_out("queries use one set of weights")


def _input(name: str, facts: SceneFacts, request: Request) -> Decision:
    """Whether the outgoing network is told the `name` of a surface."""
    if request.everything:
        return modelled(True, "everything")
    if name == "normal":
        return modelled(True, "it distinguishes surfaces that meet")
    if facts.alike:
        why = f"all {facts.smooth} surfaces are Lambertian"
        return left_out(f"{why}, and light over reflectance is learned" if name == "albedo" else why)
    if name == "roughness":
        glossy = facts.surfaces.get("glossy", 0) + facts.surfaces.get("unknown", 0)
        if not glossy:
            return left_out("no surface is glossy")
        how = [f"alpha {facts.roughness[0]:.3g} to {facts.roughness[1]:.3g}"] if facts.roughness else []
        how += [f"alpha unknown of {facts.unknown_roughness}"] if facts.unknown_roughness else []
        return modelled(True, ", ".join([f"glossy surfaces: {glossy}", *how]))
    others = facts.smooth - facts.surfaces.get("lambertian", 0)
    return modelled(True, f"{others} of {facts.smooth} surfaces are not Lambertian")


def light_samples(noise: float) -> Decision:
    """How many samples of direct light a camera sample has, by the relative variance of one."""
    n = 1 if noise < TWO_SAMPLES else 2 if noise < FOUR_SAMPLES else 4
    return modelled(n, f"variance of direct light {noise:.2g} (2 samples from {TWO_SAMPLES}, 4 from {FOUR_SAMPLES})")
