"""Tenants: who is asking, what they use and what they may use."""
