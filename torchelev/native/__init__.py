"""C++ for CPUs and CUDA kernels for GPUs, where tensors are far slower: built on demand, and never required.

Each has a twin in torch that computes the same, and that runs where nothing can be built.
"""
