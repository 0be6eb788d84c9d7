"""Batches: all scans of a session in one call, and what is to be made of them."""
