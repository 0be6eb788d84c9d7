"""A station of a live session: what it reads faces from, and where they go as they are followed.

:mod:`myoface.live.station` runs one between any of the sources (Live Link Face, OSC, JSON lines,
a take that is played again) and any of the sinks (OSC, JSON lines).
"""
