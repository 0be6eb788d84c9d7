"""Changes of a person's anatomy: fat, fillers, bones, stiffness, paralysis."""
