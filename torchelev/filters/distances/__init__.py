"""Distance transforms and signed distance fields."""
