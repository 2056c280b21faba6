"""A site in an Icechunk repository: a Zarr group whose every commit is a version. Needs ``torchelev[site]``."""
