"""Tables of the built-in neck, and where their numbers come from."""
