"""The same recordings through torchelev and through other maps that users can install."""
