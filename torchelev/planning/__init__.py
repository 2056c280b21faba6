"""Planning on a map: footprint checks, traversal costs, local paths and queries. Robot control is not here."""
