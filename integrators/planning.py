"""How an integrator with caches comes to its plan, and follows it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import mitsuba as mi

from mi_neural import plan
from mi_neural.light_noise import light_noise
from mi_neural.lights.entries import is_emissive_mesh
from mi_neural.lights.inexact import inexact

#: Keys of the network's sizes, as fields of its shape.
SIZES = {"levels": "n_levels", "hashmap_size": "hashmap_size", "width": "width", "hidden_layers": "n_hidden"}


def make_plan(integrator, scene, sensor) -> plan.ScenePlan:
    """The plan of an integrator in a scene, that of its light sampler included. Changes neither."""
    facts = plan.SceneFacts.read(scene, sensor)
    cache = integrator.cache
    default = cache.SHAPE() if isinstance(cache.shape, cache.SHAPE) else None  # None: a cache of the user's own
    request = plan.Request(
        integrator.plugin, integrator.plan_mode, integrator.given, integrator.caches, integrator.max_depth,
        integrator.cache.blend, {key: getattr(default, name) for key, name in SIZES.items() if hasattr(default, name)},
        partial(light_noise, scene, sensor) if integrator.CHOOSES_LIGHTS else None,
    )  # fmt: skip
    made = plan.of_integrator(facts, request)
    sampler = sampler_of(integrator, made)
    if sampler is not None:
        theirs = sampler.make_plan(facts).decisions
        if not theirs["light_sampler"].modelled:
            made.decisions["light_sampler"] = theirs["light_sampler"]
        made.decisions |= {part: d for part, d in theirs.items() if part != "light_sampler"}
    return made


def sampler_of(integrator, made: plan.ScenePlan):
    """The light sampler of a plan: the nested one, else the one that the plan names, if any."""
    if integrator.nested_sampler is not None:
        return integrator.nested_sampler
    name, known = made["light_sampler"], integrator.light_sampler
    if not name or (known is not None and known.plugin == name):
        return known if name else None
    return mi.load_dict({"type": name, "plan": integrator.plan_mode})


def follow(integrator, made: plan.ScenePlan) -> None:
    """Build what a plan says. The inputs of the network of a cache that was loaded stay."""
    integrator.state.plan = made
    integrator.light_sampler = sampler_of(integrator, made)
    shape = integrator.cache.shape
    if hasattr(shape, "inputs") and integrator.state.loaded is None and made.modelled("cache"):
        integrator.cache.shape = replace(shape, inputs=tuple(name for name in plan.INPUTS if made[name]))


def fits(theirs, mine) -> bool:
    """Whether a field of shape `theirs` can take the place of one of shape `mine`: all sizes are equal. What the
    network gets as inputs may differ; that goes with the field."""
    return replace(theirs, inputs=mine.inputs) == mine if hasattr(theirs, "inputs") else theirs == mine


def exact_sampler(scene):
    """A light sampler for an integrator without one, where Mitsuba's own next-event estimation is wrong; else None."""
    emitters = scene.emitters()
    if not any(inexact(emitter) for emitter in emitters):
        return None
    n = sum(e.get_shape().primitive_count() if is_emissive_mesh(e) else 1 for e in emitters)
    return mi.load_dict({"type": "uniform_lights" if n < 3 else "power_lights"}) if n <= plan.MOST_LOOKED_AT else None
