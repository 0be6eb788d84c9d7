"""Clients without a key, slow and many, while a customer works."""
