"""The maps that heads are trained on: tiles of ground, walks, sensors, and the data set made of them."""
