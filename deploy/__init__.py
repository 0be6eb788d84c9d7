"""Putting the service on a host: what the containers run, and a check of it without containers."""
