"""More than one height per cell: ceilings, tables, bridges and floors above each other. Reading them: `views`."""
