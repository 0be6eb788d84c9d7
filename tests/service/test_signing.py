"""Signatures that any Standard Webhooks library accepts."""

from __future__ import annotations

import base64
import time

import pytest
from standardwebhooks.webhooks import Webhook, WebhookVerificationError

from service.webhooks import signing

MASTER = b"m" * 32


def test_the_published_example() -> None:
    made = signing.headers(
        "msg_p5jXN8AQM9LWM0D4loKWxJek",
        1614265330,
        b'{"test": 2432232314}',
        ["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"],
    )
    assert made == {
        "webhook-id": "msg_p5jXN8AQM9LWM0D4loKWxJek",
        "webhook-timestamp": "1614265330",
        "webhook-signature": "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=",
    }


def test_both_secrets_verify_while_one_is_rotated() -> None:
    body = b'{"type":"job.succeeded"}'
    secrets = [signing.secret(MASTER, "hook", generation) for generation in (2, 1)]
    made = signing.headers("msg_1", int(time.time()), body, secrets)
    for secret in secrets:
        assert Webhook(secret).verify(body, made) == {"type": "job.succeeded"}
    third = Webhook(signing.secret(MASTER, "hook", 3))
    with pytest.raises(WebhookVerificationError):
        third.verify(body, made)
    with pytest.raises(WebhookVerificationError):
        Webhook(secrets[0]).verify(body + b" ", made)
    with pytest.raises(WebhookVerificationError):
        Webhook(secrets[0]).verify(body, made | {"webhook-id": "msg_2"})


def test_secrets_differ_by_webhook_generation_and_master() -> None:
    secrets = {
        signing.secret(master, hook, generation)
        for master in (MASTER, b"n" * 32)
        for hook in ("a", "b")
        for generation in (1, 2)
    }
    assert len(secrets) == 8
    assert all(len(base64.b64decode(text.removeprefix("whsec_"))) == 32 for text in secrets)
