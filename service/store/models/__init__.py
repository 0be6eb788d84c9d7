"""The tables."""

from service.store.models.base import Base, Owned, UtcDateTime, new_id, now
from service.store.models.jobs import Artifact, Attempt, Event, FrameChunk, Job, LogLine, Rig
from service.store.models.people import Capture, Subject, Template, Upload
from service.store.models.records import AnsweredRequest, AuditEntry, Deletion
from service.store.models.tenants import DEFAULT_TENANT, ApiKey, Tenant
from service.store.models.webhooks import Delivery, Webhook, WebhookEvent
from service.store.models.work import Lease, Worker

__all__ = [
    "DEFAULT_TENANT",
    "AnsweredRequest",
    "ApiKey",
    "Artifact",
    "Attempt",
    "AuditEntry",
    "Base",
    "Capture",
    "Deletion",
    "Delivery",
    "Event",
    "FrameChunk",
    "Job",
    "Lease",
    "LogLine",
    "Owned",
    "Rig",
    "Subject",
    "Template",
    "Tenant",
    "Upload",
    "UtcDateTime",
    "Webhook",
    "WebhookEvent",
    "Worker",
    "new_id",
    "now",
]
