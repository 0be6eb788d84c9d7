"""The command line, the client and the demonstration."""
