"""Living flesh in benchmarks: checks against known answers, contact, sliding, speed, effects."""

from benchmarks.physics.section import section

__all__ = ["section"]
