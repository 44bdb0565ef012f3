"""Trainings of runs on disk: many at once, in processes or in one program."""
