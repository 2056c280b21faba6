"""Sensors on many robots at once, whose rays are cast at height fields and boxes."""
