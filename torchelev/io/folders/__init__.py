"""Folders of scans as recordings: clouds, depth images, intrinsics and pose files, in the layouts people have."""
