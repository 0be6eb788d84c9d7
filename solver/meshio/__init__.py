"""Mesh files: one module a format, strict for registered scans, lenient for raw ones."""
