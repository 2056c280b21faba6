"""Train and evaluate policies for TerrainNav: `python -m training.nav`."""
