"""Height fields for many environments: their shapes, and grids of tiles of rising difficulty."""
