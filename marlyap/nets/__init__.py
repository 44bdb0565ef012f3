"""Functions with weights, for one sample."""
