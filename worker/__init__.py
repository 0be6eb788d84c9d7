"""The Celery app: claim, supervise, commit."""
