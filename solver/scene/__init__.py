"""Scenes: what is simulated, declared in a JSON document."""
