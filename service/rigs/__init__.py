"""Rigs and the files that jobs leave."""
