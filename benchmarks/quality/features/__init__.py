"""What each feature of the map is worth: recordings, a metric per feature, and the comparison on, off and baseline."""
