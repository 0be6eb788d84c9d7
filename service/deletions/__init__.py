"""Receipts of what was deleted."""
