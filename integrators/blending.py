"""Which weights answer the queries of a cache: the keys ``blend`` and ``reliability``, of ``nirc`` and ``nrc``."""

from __future__ import annotations

from dataclasses import dataclass, field

from mi_neural.caches.blend import BLENDS
from mi_neural.caches.reliability import MEASURES, Reliability


@dataclass(frozen=True)
class Blending:
    """Which weights answer, how two sets of them are compared, and `last_rate` where no key says it."""

    blend: str = "ema"
    reliability: Reliability = field(default_factory=Reliability)
    last_rate: float = 0.1


def blending_of(props, default: str = "ema") -> Blending:
    """What the keys say; `default`: the ``blend`` where they do not. ValueError for a value out of range."""
    blend, measure = props.get("blend", default), props.get("reliability", "evidence")
    for key, value, known in (("blend", blend, BLENDS), ("reliability", measure, MEASURES)):
        if value not in known:
            raise ValueError(f"{props.plugin_name()}: {key} is '{value}'; give one of: {', '.join(known)}")
    try:
        reliability = Reliability(
            measure=measure, split_normals=props.get("reliability_normals", False),
            decay=props.get("reliability_decay", Reliability.decay),
            warm_up=props.get("reliability_warm_up", Reliability.warm_up),
            kappa=props.get("reliability_kappa", Reliability.kappa),
            epsilon=props.get("reliability_epsilon", Reliability.epsilon),
            resolution=props.get("reliability_resolution", Reliability.resolution),
        )  # fmt: skip
    except ValueError as e:
        raise ValueError(f"{props.plugin_name()}: reliability_{e}") from None
    return Blending(blend, reliability, 0.1 if blend == "ema" or "blend" not in props else 1.0)
