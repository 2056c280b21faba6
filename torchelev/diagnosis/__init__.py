"""What looks wrong in the inputs of a map, with the likely cause and a fix, and warnings about the pace of updates."""
