"""Rasters of other programs as prior ground of a site. How they are read is in `torchelev.io.rasters`."""
