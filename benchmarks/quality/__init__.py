"""How close maps, features and plans come to the ground truth: one folder per benchmark, each a command."""
