"""Figures of the documentation that no benchmark or training draws: surfaces, a real scan, a pair of episodes, legs."""
