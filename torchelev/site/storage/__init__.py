"""A site's tiles on disk: Zarr 3, committed all or nothing. What the tiles mean is the business of `torchelev.site`."""
