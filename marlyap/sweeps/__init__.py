"""Many runs of one plan: grids, lists of cells and searches, on one machine or many."""
