"""Signatures of webhooks (Standard Webhooks 1.0: symmetric, ``v1``).

No secret is stored: each is derived from the service's master secret, and rotating a webhook's
secret counts its generation up.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from collections.abc import Sequence

PREFIX = "whsec_"


def secret(master: bytes, webhook_id: str, generation: int) -> str:
    """Return a webhook's secret as its receiver keeps it: ``whsec_`` and base64 of 32 bytes."""
    label = f"webhook:{webhook_id}:{generation}".encode()
    return PREFIX + base64.b64encode(_digest(master, label)).decode()


def headers(event_id: str, moment: int, body: bytes, secrets: Sequence[str]) -> dict[str, str]:
    """Return the headers that prove who sent ``body``.

    Parameters
    ----------
    event_id
        The same at every try, so that a receiver can drop what it has seen.
    moment
        Now, in seconds since 1970: receivers refuse old messages.
    secrets
        The webhook's secret; while it is being rotated also the one before.
    """
    signed = f"{event_id}.{moment}.".encode() + body
    keys = (base64.b64decode(secret.removeprefix(PREFIX)) for secret in secrets)
    signatures = (base64.b64encode(_digest(key, signed)).decode() for key in keys)
    return {
        "webhook-id": event_id,
        "webhook-timestamp": str(moment),
        "webhook-signature": " ".join(f"v1,{signature}" for signature in signatures),
    }


def _digest(key: bytes, message: bytes) -> bytes:
    return hmac.new(key, message, hashlib.sha256).digest()
