"""What a policy reads: height scans, foot heights and images of the map, and how unknown cells are filled."""
