"""More than one height per cell: ceilings, tables, bridges and floors above each other. Reading them: `views`."""

#: Layers that a map with levels has besides; what reads files needs no PyTorch for it.
LAYERS = ("ceiling", "clearance")
HINT = "give the config levels=LevelsConfig(max_levels=3)"  # to maps without
