"""The API as an application: `create_app` for uvicorn and the tests."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version

from anyio import to_thread
from fastapi import FastAPI

from service import errors, http, openapi
from service.access import bootstrap
from service.access.keys import Keyring
from service.access.limits import ConnectionLimit, KeyLookups, RateHeaders, Rates
from service.access.routes import keys_router, tenants_router
from service.access.signed import Signer
from service.background import Background
from service.batches.routes import router as batches
from service.batches.service import BatchRunner
from service.captures.routes import router as captures
from service.dependencies import check_parts
from service.jobs.following import Feed
from service.jobs.routes import router as jobs
from service.jobs.service import FRAME_READERS, frames_busy
from service.live.broker import LiveBroker
from service.live.routes import router as live
from service.live.tickets import Tickets
from service.outbound import Sender
from service.page.routes import router as page
from service.records.audit import ReadLog
from service.records.routes import audit_router, deletions_router
from service.rigs.routes import router as rigs
from service.secret import secret
from service.settings import Settings
from service.store.ballast import Ballast
from service.store.database import Store
from service.subjects.routes import router as subjects
from service.system import metrics
from service.system.routes import router as system
from service.system.scrubber import Scrubber
from service.system.service import ReadinessCache
from service.templates.routes import router as templates
from service.uploads.routes import router as uploads
from service.uploads.service import UploadCleaner
from service.webhooks.routes import router as webhooks
from service.writers import Places

DESCRIPTION = """
Registered 3D scans of one person in, a muscle-driven face out.

Upload a neutral scan and a few expressions, make them captures of a subject, run `build_model`,
`fit_geometry` and `fit_activations`, watch the jobs and download the rig. Lengths are millimetres,
angles radians; the frame is x to the subject's left, y up, z forward.
"""

TAGS = [
    {"name": "uploads", "description": "Resumable, checksummed (tus 1.0)."},
    {"name": "subjects", "description": "The people."},
    {"name": "captures", "description": "A subject's named scans."},
    {"name": "batches", "description": "All scans of a session in one call."},
    {"name": "templates", "description": "Anatomies that a studio brings."},
    {"name": "jobs", "description": "The work: submit, watch, cancel."},
    {"name": "live", "description": "A face that follows frames as they are captured."},
    {"name": "rigs", "description": "The results and their files."},
    {"name": "keys", "description": "API keys: make, rotate, revoke."},
    {"name": "tenants", "description": "Who is asking, and what its tenant uses."},
    {"name": "deletions", "description": "Receipts of what was deleted."},
    {"name": "audit", "description": "Who did what."},
    {"name": "webhooks", "description": "Who is told what happens."},
    {"name": "system", "description": "Health, limits and kinds of job."},
]

ROUTERS = (
    uploads,
    subjects,
    captures,
    batches,
    templates,
    jobs,
    rigs,
    live,
    webhooks,
    keys_router,
    tenants_router,
    audit_router,
    deletions_router,
    system,
    page,
)


def create_app(settings: Settings | None = None) -> FastAPI:
    """Return the application; without ``settings`` the environment's are used."""
    settings = settings or Settings()
    store = Store(settings.database, settings.files, settings.broker)
    master = secret(settings)
    keyring = Keyring(store, master, KeyLookups(settings.unknown_keys_per_minute))
    rates = Rates(settings.broker, settings.rate_per_minute, settings.tenant_rate_per_minute)
    ballast = Ballast(None if settings.database_url else settings.data_dir)
    reads = ReadLog(store)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await to_thread.run_sync(bootstrap.prepare, store, keyring, settings)
        background = [*_runners(store, settings), keyring.uses, ballast, reads]
        for thread in background:
            thread.start()
        yield
        for thread in background:
            await to_thread.run_sync(thread.stop)
        rates.close()
        await app.state.live_broker.close()
        store.close()

    app = FastAPI(
        title="Myoface",
        version=_version(),
        description=DESCRIPTION,
        openapi_tags=TAGS,
        lifespan=lifespan,
        openapi_url=None,  # `service.openapi` sends it
        docs_url=None,  # FastAPI's own pages load their scripts from elsewhere
        redoc_url=None,
        generate_unique_id_function=openapi.operation_id,
        license_info={"name": "MIT", "url": "https://opensource.org/license/mit"},
        redirect_slashes=False,  # it would lead away from TLS, behind a proxy that is not known
    )
    app.state.settings = settings
    app.state.store = store
    app.state.feed = Feed(store)
    app.state.streams = ConnectionLimit(
        "stream.too_many",
        "streams of events",
        settings.max_tenant_streams,
        settings.max_key_streams,
    )
    app.state.downloads = ConnectionLimit(
        "download.too_many", "downloads", settings.max_tenant_downloads, settings.max_key_downloads
    )
    app.state.live_connections = ConnectionLimit(
        "live.too_many",
        "connections to live sessions",
        settings.max_tenant_live,
        settings.max_key_live,
    )
    app.state.live_broker = LiveBroker(settings.broker)
    app.state.tickets = Tickets(master, settings.live_ticket_seconds)
    app.state.keyring = keyring
    app.state.readiness = ReadinessCache(store, settings)
    app.state.ballast = ballast
    app.state.reads = reads
    app.state.master = master
    app.state.rates = rates
    app.state.signer = Signer(master)
    app.state.writers = Places()
    app.state.frame_readers = Places(FRAME_READERS, frames_busy)
    app.state.sender = Sender(settings.webhook_timeout, settings.webhook_allow)
    errors.install(app)
    for router in ROUTERS:
        app.include_router(router)
    openapi.install(app)
    app.add_middleware(RateHeaders)
    http.install(app, keyring, settings)
    metrics.install(app, store, settings)
    check_parts(app)
    return app


def _runners(store: Store, settings: Settings) -> list[Background]:
    """Return the threads of this process that work on the store."""
    runners: list[Background] = [BatchRunner(store, settings), UploadCleaner(store, settings)]
    if settings.scrub_per_minute:
        runners.append(Scrubber(store, settings))
    return runners


def _version() -> str:
    try:
        return version("myoface")
    except PackageNotFoundError:
        return "0"
