"""Games that are played outside JAX, of any make: nothing here imports JAX."""
