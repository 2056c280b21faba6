"""Training, evaluation and export of walking policies for the quadruped."""
