"""Maps with levels in exact scenes, and where there is one height."""
