"""The result of a fit, its exports and its pictures."""
