"""Pure functions of samples: no module here knows a scene or a sampler."""
