"""The dearest requests that a service has to refuse, and who else waits for them."""
