"""The data side of the service, which the worker shares: tables, files, the job table's rules."""
