"""Pages of the documentation, and the programs that draw their pictures and write their tables."""
