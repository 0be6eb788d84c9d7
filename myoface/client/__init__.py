"""The service from Python: subjects, scans, jobs and rigs over HTTP.

with Client("http://127.0.0.1:8765") as client:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, Path("neutral.obj"), role="neutral")
    job = client.run("build_model", subject.id)

:class:`AsyncClient` has the same methods, to be awaited. It is the one that is written:
``scripts/unasync.py`` makes :class:`Client` of it.
"""

from myoface.client.aio import AsyncClient
from myoface.client.credentials import DEFAULT_URL
from myoface.client.jobs import Watcher, unwatched
from myoface.client.live_frames import LiveFrame, Timed
from myoface.client.retry import ClientOptions
from myoface.client.sync import Client

__all__ = [
    "DEFAULT_URL",
    "AsyncClient",
    "Client",
    "ClientOptions",
    "LiveFrame",
    "Timed",
    "Watcher",
    "unwatched",
]
