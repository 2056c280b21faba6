"""Files of settings and weights, and how any file is written: whole, or not at all. Maps and recordings: `io`."""
