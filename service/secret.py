"""The service's secret, from which the hashes of keys are made: one for all API processes."""

from __future__ import annotations

import os
import secrets
import time
from pathlib import Path

from service.settings import Settings

LEAST_BYTES = 32


def secret(settings: Settings) -> bytes:
    """Return ``MYOFACE_SECRET_KEY``, or the secret that the data folder has, made if need be."""
    if settings.secret_key is not None:
        return settings.secret_key.get_secret_value().encode()
    path = settings.data_dir / "secret"
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not path.exists():
        _make(path)
    return path.read_bytes()


def wait_for_secret(settings: Settings, seconds: float) -> bytes:
    """Return the API's secret without making one: another would sign what nobody can verify.

    Raises
    ------
    TimeoutError
        If there is none within ``seconds``, in which an API that starts with the caller makes it.
    """
    deadline = time.monotonic() + seconds
    while settings.secret_key is None and not (settings.data_dir / "secret").exists():
        if time.monotonic() > deadline:
            raise TimeoutError("set MYOFACE_SECRET_KEY to the API's, or share its data folder")
        time.sleep(0.1)
    return secret(settings)


def _make(path: Path) -> None:
    """Write a new secret, unless another process that starts with this one was faster."""
    fresh = path.with_name(f"secret.{os.getpid()}")
    descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(secrets.token_hex(LEAST_BYTES).encode())
    try:
        os.link(fresh, path)
    except FileExistsError:
        pass
    finally:
        fresh.unlink()
