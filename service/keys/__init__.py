"""API keys: made, rotated and revoked over HTTP."""
