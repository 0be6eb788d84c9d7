"""The HTTP API, the job table and the files; it never computes."""
