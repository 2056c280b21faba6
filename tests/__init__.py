"""Tests, in the same rooms as what they test; `reference.py` has every equation again, as slow loops."""
