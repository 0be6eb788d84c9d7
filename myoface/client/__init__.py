"""The service from Python: subjects, scans, jobs and rigs over HTTP.

with Client("http://127.0.0.1:8765") as client:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, Path("neutral.obj"), role="neutral")
    job = client.run("build_model", subject.id)

:class:`AsyncClient` has the same methods, to be awaited.
"""

from myoface.client._operations import DEFAULT_URL, Watcher, unwatched
from myoface.client.aio import AsyncClient
from myoface.client.sync import Client

__all__ = ["DEFAULT_URL", "AsyncClient", "Client", "Watcher", "unwatched"]
