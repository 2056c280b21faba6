"""What travels between robots, readers and the merger: messages, their signatures, and Zenoh that carries them."""
