"""Bundles for robots: a trained team with its contract, three runtimes and a team of processes."""
