"""Trainings: one file per job. Application code: run from the checkout."""
