"""Usual mistakes on a simulated walk, and their pictures, for `docs/troubleshooting.md`."""
