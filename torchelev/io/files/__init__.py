"""Formats of single files: arrays, PCD, layouts of binary files and pose files, intrinsics of cameras.

`torchelev.io.clouds`, `.depth` and `.poses` read files of all formats. Nothing here knows folders or bags.
"""
