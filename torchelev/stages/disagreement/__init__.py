"""By how much sensors, or successive scans, disagree in height."""
