"""A test that breaks the running service on purpose and counts what became of its jobs."""
