"""A merge: the windows of robots, aligned with the site and fused into its tiles."""
