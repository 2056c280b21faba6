"""Folders of scans as recordings: which files are scans, which pose belongs to each, and motion within scans."""
