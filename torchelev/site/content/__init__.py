"""What a site holds in memory: its tiles, the layers of its channels and levels in them, and how they are read."""
