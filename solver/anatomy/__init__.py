"""Template anatomies, their transfer to a subject, tetrahedra and muscle weights."""
