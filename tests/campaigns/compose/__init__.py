"""The service as docker-compose.yml describes it, run by hand without containers."""
