"""Stand-in jobs of a solver process that somebody has taken over by a file of his."""
