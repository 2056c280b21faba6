"""The training of the learned traversability head: labels, maps, fit and evaluation."""
