"""The training of the completion network, and its comparison with other ways to fill a map."""
