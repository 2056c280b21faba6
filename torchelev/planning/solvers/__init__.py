"""Two ways to solve for the cost to go: Dijkstra's algorithm in C++, and sweeps of value iteration by tensors."""
