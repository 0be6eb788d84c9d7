"""The check of a take of markers, its findings and its picture."""
