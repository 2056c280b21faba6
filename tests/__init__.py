"""Tests, in the same rooms as what they test; `reference/` has every equation again, as slow loops."""
