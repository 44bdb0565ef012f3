"""Algorithms, constraints, and the training loop on the device."""
