"""The calls about who is asking and who is told: keys, their use, and webhooks."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from myoface.client.aio_connection import AsyncConnection
from myoface.client.answers import read_json
from myoface.tenant import AuditEntry, Delivery, Key, Me, NewKey, NewWebhook, Scope, Usage, Webhook


class AsyncAccess(AsyncConnection):
    """Calls that need no scans: of a tenant's keys and webhooks."""

    # Keys

    async def me(self) -> Me:
        """Return whose key this client has."""
        return await self._get("/v1/me", Me)

    async def usage(self) -> Usage:
        """Return what the tenant uses, and its quotas."""
        return await self._get("/v1/usage", Usage)

    async def keys(self) -> list[Key]:
        """Return the tenant's API keys, newest first."""
        return await self._list("/v1/keys", Key)

    async def create_key(
        self, name: str, scopes: Iterable[Scope], *, expires_at: datetime | None = None
    ) -> NewKey:
        """Make an API key; its text is told this once. ``expires_at`` has a time zone."""
        until = expires_at and expires_at.isoformat()
        return await self._create(
            "/v1/keys", NewKey, name=name, scopes=list(scopes), expires_at=until
        )

    async def rotate_key(self, key_id: str, *, grace: int = 24 * 3600) -> NewKey:
        """Replace an API key; the old one goes on for ``grace`` seconds."""
        return await self._create(f"/v1/keys/{key_id}/rotate", NewKey, grace=grace)

    async def revoke_key(self, key_id: str) -> None:
        """Take an API key back at once."""
        await self._request("DELETE", f"/v1/keys/{key_id}")

    async def audit(self, object_id: str | None = None) -> list[AuditEntry]:
        """Return what was done with the tenant's keys, newest first."""
        return await self._list("/v1/audit", AuditEntry, object_id=object_id)

    # Webhooks

    async def webhooks(self) -> list[Webhook]:
        """Return the webhooks, newest first."""
        return await self._list("/v1/webhooks", Webhook)

    async def webhook(self, webhook_id: str) -> Webhook:
        """Return one webhook, and whether it works."""
        return await self._get(f"/v1/webhooks/{webhook_id}", Webhook)

    async def create_webhook(
        self, url: str, *, events: Iterable[str] = (), kinds: Iterable[str] = ()
    ) -> NewWebhook:
        """Have an address told what happens; its secret is told this once.

        Without ``events`` it is told all of them, without ``kinds`` of jobs of all kinds.
        """
        return await self._create(
            "/v1/webhooks", NewWebhook, url=url, events=list(events), kinds=list(kinds)
        )

    async def change_webhook(
        self,
        webhook_id: str,
        *,
        url: str | None = None,
        events: Iterable[str] | None = None,
        kinds: Iterable[str] | None = None,
        active: bool | None = None,
    ) -> Webhook:
        """Change a webhook; what is not given stays. ``active`` starts a failed one again."""
        change = {
            "url": url,
            "events": None if events is None else list(events),
            "kinds": None if kinds is None else list(kinds),
            "active": active,
        }
        given = {key: value for key, value in change.items() if value is not None}
        response = await self._request("PATCH", f"/v1/webhooks/{webhook_id}", json=given)
        return Webhook.read(read_json(response))

    async def delete_webhook(self, webhook_id: str) -> None:
        """Delete a webhook with its log."""
        await self._request_once("DELETE", f"/v1/webhooks/{webhook_id}")

    async def rotate_webhook(self, webhook_id: str) -> NewWebhook:
        """Give a webhook a new secret; for a day the old one signs too."""
        return await self._create(f"/v1/webhooks/{webhook_id}/rotate", NewWebhook)

    async def try_webhook(self, webhook_id: str) -> Delivery:
        """Send a ``webhook.test``; the delivery tells how it went."""
        response = await self._request_once("POST", f"/v1/webhooks/{webhook_id}/test")
        return Delivery.read(read_json(response))

    async def deliveries(self, webhook_id: str, *, state: str | None = None) -> list[Delivery]:
        """Return what was sent in the last 30 days, newest first, in one ``state`` if given."""
        return await self._list(f"/v1/webhooks/{webhook_id}/deliveries", Delivery, state=state)

    async def delivery(self, delivery_id: str) -> Delivery:
        """Return an event on its way, or what became of it."""
        return await self._get(f"/v1/deliveries/{delivery_id}", Delivery)

    async def redeliver(self, delivery_id: str) -> Delivery:
        """Send an event to its webhook once more, with the same id."""
        response = await self._request_once("POST", f"/v1/deliveries/{delivery_id}/redeliver")
        return Delivery.read(read_json(response))
