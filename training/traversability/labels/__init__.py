"""Where a robot can stand on the true ground, by geometry, and the physics simulation that checks it."""
