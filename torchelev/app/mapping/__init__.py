"""`torchelev map`: its options, the scans they name, fusing them, and the files it writes."""
