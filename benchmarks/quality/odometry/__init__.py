"""Maps with poses by lidar odometry, beside those with true poses, on a simulated drive over rough ground."""
