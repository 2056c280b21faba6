"""A site that several processes share: one collective makes each of them merge what all have."""
