"""The labels: where a robot can stand on the true ground, and the physics that checks them."""
