"""An episode: how robots start, what is commanded and rewarded, and how it ends."""
