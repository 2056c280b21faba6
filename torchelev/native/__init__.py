"""C++ for CPUs, where tensors are far slower: built on demand, and never required.

Each function has a twin in torch that computes the same, and that runs where there is no compiler.
"""
