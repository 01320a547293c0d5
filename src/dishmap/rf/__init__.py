"""From surface to signal: rays, currents, the far field, gain, and the subreflector that wins gain back."""
