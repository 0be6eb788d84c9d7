"""Activations, jaw and head from a few dozen markers."""
