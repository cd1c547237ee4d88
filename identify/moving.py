"""What a model of a joint that moves is made of: the whole of the paper's Fig. 2, in shapes that are free."""

EFFECTS = ("passive_torque:surface", "torque_angle:smooth", "torque_velocity:surface")
"""For `fit`: h(x, ẋ), then g(x, ẋ) as a curve over the angle times a hyperbola over the velocity; f, G, g and h are
then estimated together from all parts of a joined record."""
