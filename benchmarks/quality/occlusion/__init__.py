"""Whether a planner distinguishes a safe occlusion from a drop, and refines a path by the gradient of its cost."""
