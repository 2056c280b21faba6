"""How long updates, sensors, filters and training steps take, and how much memory an update needs."""
