"""Episodes of a game under a controller, and what is measured on them."""
