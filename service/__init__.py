"""The HTTP API and the job table."""
