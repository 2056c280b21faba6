"""Training, evaluation and export of policies for TerrainNav."""
