"""What leaves training for a robot: the policy, what it reads, the map's config, and an episode to check them by."""
