"""Files of settings, and how any file is written: whole, or not at all. Maps and recordings: `io`."""
