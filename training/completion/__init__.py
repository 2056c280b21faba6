"""The training of the completion network, and its evaluation beside other ways to fill a map."""
