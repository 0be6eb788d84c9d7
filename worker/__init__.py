"""The Celery app: claim a job, supervise its solver process, commit what it left."""
