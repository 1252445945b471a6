"""``power_lights``: lights in proportion to their power."""

import mitsuba as mi

from mi_neural.emitters.common import LightSampler
from mi_neural.lights.sampling import PowerLights


class PowerLightSampler(LightSampler):
    r"""
    .. _emitter-power_lights:

    Choice of lights by power (:monosp:`power_lights`)
    ---------------------------------------------------

    Chooses light :math:`i` with a probability proportional to :math:`\Phi_i`; a tenth of the probability is shared
    equally. :math:`\Phi_i` is the power :math:`\pi L A` of a surface; of a lamp without extent :math:`\pi` times its
    largest radiant intensity, so that it counts as a surface that gives as much to what it faces; of a light at
    infinity its irradiance times the cross-section of the scene. A light is an emissive triangle (a rectangle counts as
    one light), or any other emitter as a whole. Unbiased.

    .. pluginparameters::

     * - plan
       - |string|
       - ``scene``: build only what the scene needs. ``everything``: build all parts, to compare and to look for
         faults. (Default: scene)

    *Works with* all emitters of Mitsuba, nested in an integrator of this package under the name ``light_sampler``.
    *Leaves out* distance, direction and shadows (use ``nvc_lights``).

    .. tabs::
        .. code-tab:: xml

            <integrator type="plain_path"> <emitter type="power_lights" name="light_sampler"/> </integrator>

        .. code-tab:: python

            mi.load_dict({"type": "plain_path", "light_sampler": {"type": "power_lights"}})
    """

    def make(self, scene, table):
        return PowerLights(table)


mi.register_emitter("power_lights", lambda props: PowerLightSampler(props))
