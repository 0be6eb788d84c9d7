"""Live sessions: jobs that follow a performer's frames as they come, and who is connected."""
