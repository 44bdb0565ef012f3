"""What is played: plants, games, what agents see, and perturbations of a game."""
