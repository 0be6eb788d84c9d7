"""Readable tables behind the built-in face."""
