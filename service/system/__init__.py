"""Health, limits and kinds of job."""
