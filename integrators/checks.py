"""What integrators refuse before any work."""

from __future__ import annotations


def check_scene(scene, plugin: str) -> None:
    """Refuse, before any work, a scene that cannot be rendered; the message says what to do."""
    if not scene.sensors():
        raise ValueError(f"{plugin}: the scene has no sensor; add one, for example <sensor type=\"perspective\"/>")
    if not scene.emitters():
        raise ValueError(f"{plugin}: the scene has no emitter, the image would be black; add a light")
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            raise ValueError(
                f"{plugin}: the camera is inside a participating medium, which the cache does not model; "
                'use <integrator type="volpath"/>'
            )
    for shape in scene.shapes():
        if shape.is_medium_transition():
            raise ValueError(
                f"{plugin}: shape '{shape.id()}' borders a participating medium, which the cache does not model; "
                'use <integrator type="volpath"/>'
            )


def sensor_of(scene, sensor, plugin: str):
    """The sensor of that number, or the sensor given. Raises ValueError where there is none."""
    if not isinstance(sensor, int):
        return sensor
    if not scene.sensors():
        check_scene(scene, plugin)
    if not 0 <= sensor < len(scene.sensors()):
        raise ValueError(f"{plugin}: there is no sensor {sensor}; the scene has {len(scene.sensors())}")
    return scene.sensors()[sensor]
