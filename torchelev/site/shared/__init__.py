"""A site that several processes share: collective operations merge the windows of all in each of them."""
