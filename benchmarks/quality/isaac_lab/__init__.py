"""Isaac Lab's rough velocity task with a map in place of its ideal height scan, on a CPU and without Isaac Sim."""
