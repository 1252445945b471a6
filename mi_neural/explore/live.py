"""``mi_neural.live``: a picture in a notebook that improves while the cache learns."""

from __future__ import annotations


def live(scene, integrator=None, *, sensor: int = 0, reference=None, spp: int = 1, seed: int = 0, frames: int = 1,
         width: int = 480):  # fmt: skip
    """A live view of `scene` for a notebook: ``mi_neural.live(scene, "nirc")``.

    The picture goes on as long as it is seen and nothing else runs in the notebook. Drag in it to orbit, turn the wheel
    to come nearer, click for the hemisphere of light that arrives at a point. Sliders set camera, lights and keys of
    the integrator; a drop-down list shows the reliability map or a light's visibility in place of the picture.

    scene        a ``mi.Scene``; camera and lights are moved in it
    integrator   an integrator, a plugin's name, a dictionary for ``mi.load_dict``, or None: the scene's own
    sensor       number of the sensor
    reference    linear RGB (height, width, 3) or an EXR of it; the curve then shows the error against it
    spp          samples a pixel of a frame
    seed         of the samples
    frames       rendered at once, before the view appears; a notebook that is only executed keeps their picture
    width        of the picture on the page, in CSS pixels

    Returns a :class:`~mi_neural.explore.widgets.LiveView`: ``stop()``, ``go()``, ``show(...)``, ``click(x, y)``, and
    ``session``, the :class:`~mi_neural.explore.session.Session` behind it. Raises ``ImportError`` without the widgets.
    """
    try:
        from mi_neural.explore import widgets
    except ImportError as error:
        raise ImportError(
            f"a live view needs notebook widgets ({error}); type: pip install 'mi_neural[notebooks]'"
        ) from error
    from mi_neural.explore.session import Session

    return widgets.LiveView(Session(scene, integrator, sensor, reference, spp, seed), frames, width)
