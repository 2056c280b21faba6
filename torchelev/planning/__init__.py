"""What a planner asks of a map: footprints, paths, costs, and a planner over the grid."""
