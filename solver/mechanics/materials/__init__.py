"""The laws of flesh: one module each, of one tetrahedron."""
