"""The moving picture: a robot that walks with a depth camera, its growing map, and sixteen maps of a batch."""
