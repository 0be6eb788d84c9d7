"""Template anatomies that a studio brings."""
