"""Access: API keys with their scopes and tenants, and the limits on both."""
