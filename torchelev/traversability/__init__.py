"""Traversability heads: the analytic one, the learned one with its features and weights, and the paper's filter.

Training a head is in the checkout's `training/traversability`.
"""
