"""Single files: clouds and depth images of any format; arrays, PCD, layouts of binary and pose files, intrinsics.

Pose files of any format are read by `torchelev.io.poses`. Nothing here knows folders or bags.
"""
