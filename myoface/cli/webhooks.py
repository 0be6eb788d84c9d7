"""Commands about webhooks: addresses that are told what happens; they need the scope `webhooks`."""

from __future__ import annotations

from typing import Annotated

from myoface.cli.app import Url
from myoface.cli.commands import Argument, Group, Option
from myoface.cli.console import out, show_table
from myoface.cli.lookup import find_webhook
from myoface.client import DEFAULT_URL, Client
from myoface.tenant import Delivery, NewWebhook

webhooks = Group("Webhooks: addresses that are told what happens.")

WebhookId = Annotated[str, Argument(help="webhook: its id, the start of it, or its address")]
Events = Annotated[
    list[str] | None,
    Option("--event", help="job.succeeded, scan.checked ...; repeat; default: all"),
]
Kinds = Annotated[
    list[str] | None, Option("--kind", help="only of jobs of this kind; repeat; default: all")
]


@webhooks.command("add")
def add_webhook(
    address: Annotated[str, Argument(help="https://...")],
    event: Events = None,
    kind: Kinds = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Have an address told what happens; prints the id, and the secret this once."""
    with Client(url) as client:
        made = client.create_webhook(address, events=event or (), kinds=kind or ())
    out.print(made.id)
    _print_secret(made)


@webhooks.command("list")
def list_webhooks(url: Url = DEFAULT_URL) -> None:
    """List the webhooks, and which of them are off."""
    with Client(url) as client:
        rows = [
            (
                each.id,
                each.url,
                ",".join(each.events) or "all",
                ",".join(each.kinds) or "all",
                "on" if each.active else f"off: {each.disabled_reason}",
            )
            for each in client.webhooks()
        ]
    show_table(("webhook", "address", "events", "kinds", "state"), rows)


@webhooks.command("change")
def change_webhook(
    webhook: WebhookId,
    address: Annotated[str | None, Option(help="another address")] = None,
    event: Events = None,
    kind: Kinds = None,
    active: Annotated[bool | None, Option(help="start again after failures, or rest")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Change a webhook; what is not given stays."""
    with Client(url) as client:
        client.change_webhook(
            find_webhook(client, webhook), url=address, events=event, kinds=kind, active=active
        )


@webhooks.command("delete")
def delete_webhook(webhook: WebhookId, url: Url = DEFAULT_URL) -> None:
    """Delete a webhook with its log."""
    with Client(url) as client:
        client.delete_webhook(find_webhook(client, webhook))


@webhooks.command("rotate")
def rotate_webhook(webhook: WebhookId, url: Url = DEFAULT_URL) -> None:
    """Give a webhook a new secret and print it, this once; the old one signs for a day more."""
    with Client(url) as client:
        _print_secret(client.rotate_webhook(find_webhook(client, webhook)))


@webhooks.command("test")
def try_webhook(webhook: WebhookId, url: Url = DEFAULT_URL) -> None:
    """Send a webhook.test; `myoface webhooks deliveries` tells how it went."""
    with Client(url) as client:
        _show_deliveries([client.try_webhook(find_webhook(client, webhook))])


@webhooks.command("deliveries")
def list_deliveries(
    webhook: WebhookId,
    state: Annotated[str | None, Option(help="pending, delivered or failed")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """List what was sent in the last 30 days and what became of it, newest first."""
    with Client(url) as client:
        _show_deliveries(client.deliveries(find_webhook(client, webhook), state=state))


@webhooks.command("redeliver")
def redeliver(
    delivery: Annotated[str, Argument(help="delivery id")], url: Url = DEFAULT_URL
) -> None:
    """Send an event to its webhook once more."""
    with Client(url) as client:
        _show_deliveries([client.redeliver(delivery)])


def _show_deliveries(deliveries: list[Delivery]) -> None:
    rows = [
        (each.id, each.type, each.state, each.attempt, each.status, _describe_fault(each))
        for each in deliveries
    ]
    show_table(("delivery", "event", "state", "attempt", "status", "error"), rows)


def _describe_fault(delivery: Delivery) -> str | None:
    """Return the code of what went wrong and, where nobody answered, the words of it."""
    if delivery.status is None and delivery.excerpt:
        return f"{delivery.error}: {delivery.excerpt}"
    return delivery.error


def _print_secret(made: NewWebhook) -> None:
    if made.secret is None:
        out.print(f"the answer with the secret was lost: myoface webhooks rotate {made.id}")
        raise SystemExit(1)
    out.print(made.secret)
