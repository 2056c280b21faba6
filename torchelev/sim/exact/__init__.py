"""One robot in scenes of closed form: exact sensors, noise and trajectories, in float64 on the CPU."""
