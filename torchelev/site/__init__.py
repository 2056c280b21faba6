"""A site: a world map of square tiles on disk, which grows with where the robot goes."""
