"""What emits: a flat table of lights, clusters of them, and how much they reflect unshadowed."""
