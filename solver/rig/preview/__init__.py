"""Sliders in a browser: a reduced basis of simulated equilibria, with its error."""
