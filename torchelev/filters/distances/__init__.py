"""Distances to borders in the plane, and to the ground in space. Costs and paths for planning are not here."""
