"""A site's tiles on disk: Zarr 3, committed all or nothing. `torchelev.site` defines what the tiles mean."""
