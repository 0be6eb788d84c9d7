"""API and stores on one host, a worker on another, and a link between them that breaks."""
