"""The process that holds a site: it takes messages, decides which count, merges them and answers."""
