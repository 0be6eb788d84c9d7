"""Requests that the service sends to addresses that a customer names."""
