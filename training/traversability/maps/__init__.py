"""The simulated maps of training and evaluation: terrain, walks, sensors, and the data set on disk."""
