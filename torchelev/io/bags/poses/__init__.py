"""Poses of a bag: `reading` collects them in a tree of transforms, `frames` chooses those of the map and the base.

Another source of poses returns `Poses`, as `reading.read_poses` does. Messages of sensors are read one folder above.
"""
