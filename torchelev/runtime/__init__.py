"""The map without Python: the C library `libtorchelev`, from the sources that update maps on a CPU."""
