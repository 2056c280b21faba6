"""Pictures of maps: panels of layers, and the live view."""
