"""Agreement with the CPU, host synchronisation and speed on one GPU. Needs torch and numpy only."""
