"""``uniform_lights``: every light with the same probability."""

import mitsuba as mi

from mi_neural.emitters.common import LightSampler
from mi_neural.lights.sampling import UniformLights


class UniformLightSampler(LightSampler):
    r"""
    .. _emitter-uniform_lights:

    Uniform choice of lights (:monosp:`uniform_lights`)
    ----------------------------------------------------

    Chooses each light with the same probability :math:`1/N`: the plain sampler that the others are compared with. A
    light is an emissive triangle (a rectangle counts as one light), or any other emitter as a whole. Unbiased.

    .. pluginparameters::

     * - plan
       - |string|
       - ``scene``: build only what the scene needs. ``everything``: build all parts, to compare and to look for
         faults. (Default: scene)

    *Works with* all emitters of Mitsuba, nested in an integrator of this package under the name ``light_sampler``.
    Nearly every scene has less noise with ``nvc_lights``.

    .. tabs::
        .. code-tab:: xml

            <integrator type="plain_path"> <emitter type="uniform_lights" name="light_sampler"/> </integrator>

        .. code-tab:: python

            mi.load_dict({"type": "plain_path", "light_sampler": {"type": "uniform_lights"}})
    """

    def make(self, scene, table):
        return UniformLights(table)


mi.register_emitter("uniform_lights", lambda props: UniformLightSampler(props))
