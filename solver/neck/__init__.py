"""A neck that carries a head: vertebrae, muscles, and how both are moved."""
