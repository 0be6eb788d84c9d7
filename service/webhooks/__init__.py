"""Webhooks: telling a customer's systems what happened."""
