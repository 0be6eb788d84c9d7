"""Commands about API keys and who is asking; they need a key with the scope `admin`."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Annotated

from myoface.cli.app import Url
from myoface.cli.commands import Argument, Group, Option
from myoface.cli.console import out, show_table
from myoface.client import DEFAULT_URL, Client
from myoface.tenant import Key, NewKey, Scope, Use

keys = Group("API keys: make, rotate, revoke.")

KeyId = Annotated[str, Argument(help="key id")]
DAY = 24 * 3600


@keys.command("list")
def list_keys(url: Url = DEFAULT_URL) -> None:
    """List the keys, also those that open nothing any more."""
    with Client(url) as client:
        found = client.keys()
    rows = [
        (
            each.id,
            each.name,
            ",".join(each.scopes),
            each.last_used_at and f"{each.last_used_at:%Y-%m-%d %H:%M}",
            _end(each),
        )
        for each in found
    ]
    show_table(("key", "name", "scopes", "last used", "end"), rows)


@keys.command("add")
def add_key(
    name: str,
    scope: Annotated[list[Scope], Option(help="what it is good for; repeat")],
    days: Annotated[int | None, Option(min=1, help="it works so long; default: ever")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Make a key and print it, this once."""
    until = None if days is None else datetime.now(UTC) + timedelta(days=days)
    with Client(url) as client:
        _print_key(client.create_key(name, scope, expires_at=until))


@keys.command("rotate")
def rotate_key(
    key: KeyId,
    grace: Annotated[int, Option(min=0, help="s that the old one goes on to work")] = DAY,
    url: Url = DEFAULT_URL,
) -> None:
    """Make a key in another's place and print it, this once."""
    with Client(url) as client:
        _print_key(client.rotate_key(key, grace=grace))


@keys.command("revoke")
def revoke_key(key: KeyId, url: Url = DEFAULT_URL) -> None:
    """Take a key back at once."""
    with Client(url) as client:
        client.revoke_key(key)


@keys.command("whoami")
def whoami(url: Url = DEFAULT_URL) -> None:
    """Show whose key this is, what it may do, and what the tenant uses."""
    with Client(url) as client:
        me = client.me()
        usage = client.usage()
    out.print(f"{me.tenant}, key {me.key_id}: {', '.join(me.scopes)}")
    rows = [
        ("stored bytes", *_cells(usage.bytes)),
        ("queued jobs", *_cells(usage.queued)),
        ("running jobs", *_cells(usage.running)),
    ]
    show_table(("", "used", "limit"), rows)


@keys.command("audit")
def show_audit(
    about: Annotated[str | None, Option(help="only about the object of this id")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Show what was done with the tenant's keys, newest first."""
    with Client(url) as client:
        rows = [
            (f"{each.created_at:%Y-%m-%d %H:%M:%S}", each.key_id, each.action, each.object_id)
            for each in client.audit(about)
        ]
    show_table(("at", "key", "action", "object"), rows)


def _print_key(made: NewKey) -> None:
    if made.key is None:
        out.print(f"the answer with the key was lost: myoface keys rotate {made.id}")
        raise SystemExit(1)
    out.print(made.key)


def _end(key: Key) -> str | None:
    if key.revoked_at is not None:
        return f"revoked {key.revoked_at:%Y-%m-%d}"
    return f"{key.expires_at:%Y-%m-%d}" if key.expires_at else None


def _cells(use: Use) -> tuple[int, int | None]:
    return use.used, use.limit
