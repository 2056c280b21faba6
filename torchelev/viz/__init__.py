"""Pictures of map layers: panels with axes, and images whose pixels are cells. Reports are in `torchelev.app`."""
