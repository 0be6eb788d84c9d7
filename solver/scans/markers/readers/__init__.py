"""Readers of takes: files as systems write them, what they leave open, and names of markers."""
