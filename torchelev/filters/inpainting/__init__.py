"""Filters that fill holes. What a height scan fills is in `torchelev.observations.fill`."""
