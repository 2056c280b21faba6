"""Training and evaluation of the learned traversability head."""
