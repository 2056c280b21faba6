"""Filling holes: by harmonic interpolation, by the nearest or lowest neighbours, or with OpenCV."""
