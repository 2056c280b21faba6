"""What planning reads of a map around a robot: the ground below its footprint, ceilings, inclination."""
