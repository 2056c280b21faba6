"""The self-filter on a robot that trots: what it costs, and which points it takes from the legs and the ground."""
