"""What points carry besides their position: times within a scan, and colours."""
