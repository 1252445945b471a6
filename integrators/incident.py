"""What ``nirc`` and ``nirc_two_level`` share: the network of incident radiance, and its published constants."""

from __future__ import annotations

from mi_neural.caches import presets
from mi_neural.caches.encoding import SURFACE
from mi_neural.caches.incident import LOSSES, Training
from mi_neural.caches.weights import FieldShape
from mi_neural.integrators.common import CacheIntegrator

#: Rows of these keys, for the docstrings
INCIDENT_KEYS = """
     * - preset
       - |string|
       - ``measured``: the defaults below. ``paper``: the constants as printed. A key that you set overrides the preset.
         The list below has both. (Default: measured)
     * - inputs
       - |string|
       - What the network gets of a surface beside position and direction: a list of ``normal``, ``albedo``,
         ``roughness``, or ``none``. (Default: none)
     * - direction_degree
       - |int|
       - Degree of the spherical harmonics of the direction, 0 to 7. (Default: 3)
     * - loss
       - |string|
       - Loss of training, a relative squared error. ``local`` divides the squared error by the squared mean prediction
         over the hemisphere at the record's position. ``weighted``, as published, divides by the squared prediction for
         the record itself; error and prediction are multiplied by the throughput f cos/p of its direction, and the
         quotient by p. (Default: local)
     * - local_limit
       - |float|
       - For ``loss="local"``: in the divisor the mean prediction of a place counts as at most so many times the mean
         target of the scene, but at least as half of itself. So bright places have the same weight up to a limit.
         (Default: 8)"""

#: The list of the constants of both presets, for the docstrings
INCIDENT_PRESETS = """
    Constants of ``paper`` / ``measured``, and the measurement that led from one to the other. The former are those of
    Dereviannykh et al. 2025 and of the authors' published configuration, for ``reliability`` and the keys that begin
    with it (``nirc``) those of Klepikov et al.:

    - ``loss``, ``epsilon``: weighted, 0.001 / local, 10 / relative to the prediction in each direction a sunlit
      courtyard is 5.5 % too dark, by the local mean within 0.3 %; with an epsilon of 0.03 a room lit through a slit
      drifts by +7 to +12 %, with 10 by +1 to +3 %, with a ``local_limit`` of 8 as well it stays within 1 %. Cornell
      box, see below: relMSE 0.016 / 0.0023.
    - ``inputs``: normal, albedo, roughness / none / incident radiance depends on position and direction alone;
      Cornell box: relMSE 0.0025 / 0.0023.
    - ``levels``, ``width``, ``hidden_layers``, ``direction_degree``: 12, 64, 4, 4 (25 values, 5 bands) / 8, 16, 2, 3 /
      Cornell box: relMSE 0.0026 / 0.0023, after equally many steps, each of which takes longer with the former.
    - ``learning_rate``, ``last_rate``: 0.001, 1 (it does not fall) / 0.01, 0.1 / nothing is gained by 0.02; lower
      ones were not measured.
    - ``ema_decay``, ``ema_debiased``: 0.99, true / 0.99, false / not measured.
    - ``train_samples``: -1 (one path for each 8x8 pixels) / 4096 / half as many: trimmed relMSE 0.133 instead of 0.102
      (ajar door), 0.0201 instead of 0.0193 (staircase).
    - ``train_vertices``: 4 (records at up to 3) / 8 / 8 instead of 5: FLIP of the cache alone 0.151 to 0.134.
    - ``termination`` (``nirc``): balanced / adaptive / less bias with more samples, see above; of two-level: ``alpha``
      1 / measured by scene / with 1 and one residual path no variance was gained at equal samples.
    - ``reliability`` (``nirc``): correlation / evidence / steady flicker of the blend, over that of the average, 50 /
      1.00.
    - ``reliability_decay``, ``reliability_warm_up``, ``reliability_kappa``: 0.9, 128, 4 in both presets; λ counts
      frames, not records.
    - Not printed, so ours in both: ``cache_samples``, ``train_frames``, ``train_steps``, ``hashmap_size``, the grid's
      resolutions, ``reliability_epsilon``, ``reliability_resolution``, samples that end a training path.
    - The same in both, without a key: Adam with β of 0.9 and 0.99 and ε of 1e-15, two features a level, training paths
      that end in the cache (the authors' other choice: plain Monte Carlo), predictions up to 10,000 (here times the
      scene's mean radiance, in which the loss is meant, too).
    - Without a key and ours in both: the grid's box is 7.5 % larger on each side than where records fall (the authors:
      15 % larger than the scene), the shortcut past the network, points looked up above their surface, a quarter of
      the paths where records lay.

    The measurements are those of ``mi-neural doc measured`` and of the docstrings in ``mi_neural.caches``. All of the
    preset, but with 4096 paths, has a relMSE of 0.029 in the Cornell box.
"""


class IncidentIntegrator(CacheIntegrator):
    """Base of the integrators that render with a cache of incident radiance."""

    def __init__(self, props):
        self.preset = props.get("preset", "measured")
        props.use_preset(self.preset, presets.TwoLevel(), presets.ReliabilityWeighted())
        super().__init__(props)

    def training_keys(self, props) -> dict:
        loss = props.get("loss", LOSSES[0])
        self._check(loss in LOSSES, f"loss is '{loss}'; give one of: {', '.join(LOSSES)}")
        return {"loss": loss, "local_limit": props.get("local_limit", Training.local_limit)}

    def shape_keys(self, props) -> dict:
        inputs, degree = props.get("inputs", "none"), props.get("direction_degree", FieldShape.direction_degree)
        names = [n.strip() for n in inputs.split(",") if n.strip() not in ("", "none")]
        self._check(set(names) <= SURFACE.keys(),
                    f"inputs is '{inputs}'; give none, or a list of: {', '.join(SURFACE)}")  # fmt: skip
        self._check(degree >= 0, f"direction_degree is {degree}; it must lie in 0..7")
        return {"surface": tuple(name for name in SURFACE if name in names), "direction_degree": degree}
