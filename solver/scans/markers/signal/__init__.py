"""Positions over time: motion taken apart, faults of single markers, and seconds of rest."""
