"""``python -m service``: the API on ``MYOFACE_HOST`` and ``MYOFACE_PORT``."""

from __future__ import annotations

import gc
import signal
import sys

import uvicorn

from service import tracing
from service.access.bootstrap import OpenDoorError, prepare
from service.app import create_app
from service.http.deadline import DeadlineProtocol, SocketProtocol, protocol
from service.http.slots import ConnectionSlots
from service.process import configure_logs, die_with_parent, forbid_dumps, keep_private
from service.queue.streams import LARGEST
from service.settings import Settings
from service.store.database import NewerDatabaseError, UnfinishedRestoreError

# Seconds for which an idle connection stays open: longer than a proxy in front keeps it (Caddy:
# two minutes), else a request meets a connection that is being closed
KEEP_ALIVE = 130
# Seconds between two questions whether a WebSocket's client is there, and for its answer
PING = 10


def main() -> None:
    """Serve until interrupted."""
    keep_private()
    settings = Settings()
    if settings.stack_pid:
        die_with_parent(settings.stack_pid, signal.SIGTERM)
    forbid_dumps()
    configure_logs(settings.log_json)
    tracing.start("myoface-api")
    app = create_app(settings)
    try:
        prepare(app.state.store, app.state.keyring, settings)
    except (OpenDoorError, NewerDatabaseError, UnfinishedRestoreError) as error:
        sys.exit(str(error))
    gc.collect()
    gc.freeze()  # what is there for good is not walked at each collection
    slots = ConnectionSlots[DeadlineProtocol](
        settings.max_connections, settings.max_address_connections, settings.max_tenant_connections
    )
    uvicorn.run(
        app,
        host=settings.host,
        port=settings.port,
        http=protocol(settings.header_timeout, settings.send_timeout, slots),
        ws=SocketProtocol,
        ws_max_size=LARGEST,
        ws_ping_interval=PING,
        ws_ping_timeout=PING,
        # frames of numbers hardly shrink, and to pack them takes longer than to send them
        ws_per_message_deflate=False,
        # One too many is let in: the slots say which goes for it
        limit_concurrency=settings.max_connections + 1,
        log_config=None,
        access_log=False,
        timeout_keep_alive=KEEP_ALIVE,
        timeout_graceful_shutdown=3,
    )


if __name__ == "__main__":
    main()
