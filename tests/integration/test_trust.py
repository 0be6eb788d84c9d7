"""Clients of a service whose certificate is of an authority of the studio's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import anyio
import pytest

from myoface.client import AsyncClient, Client, credentials
from myoface.errors import ApiError
from service.app import create_app
from service.settings import Settings
from tests.certificate import self_signed
from tests.command_line import invoke
from tests.hostile.edge import serving


@pytest.fixture
def service(tmp_path: Path) -> Iterator[tuple[str, str, Path]]:
    """Serve over TLS; gives the address, a key, and the file of the authority."""
    settings = Settings(data_dir=tmp_path / "data")
    private, authority = self_signed(tmp_path, "IP:127.0.0.1")
    tls = {"ssl_keyfile": str(private), "ssl_certfile": str(authority)}
    with serving(create_app(settings), 10, **tls) as port:
        yield f"https://127.0.0.1:{port}", settings.admin_key.read_text(), authority


def test_the_authority_is_given_and_no_other_counts(
    service: tuple[str, str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    url, key, authority = service

    async def awaited(ca: Path | None) -> str:
        async with AsyncClient(url, key, ca=ca) as client:
            return (await client.me()).tenant

    with Client(url, key, ca=authority) as client:
        assert client.me().tenant == "default"
    assert anyio.run(awaited, authority) == "default"
    with Client(url, key) as client, pytest.raises(ApiError, match=r"(?i)certificate") as caught:
        client.me()
    assert caught.value.code == "client.unreachable"
    with pytest.raises(ApiError, match=r"(?i)certificate"):
        anyio.run(awaited, None)

    monkeypatch.setenv(credentials.KEY_VARIABLE, key)
    asked = ["subjects", "list", "--url", url]
    assert invoke(asked).exit_code == 1
    monkeypatch.setenv(credentials.CA_VARIABLE, str(authority))
    assert invoke(asked).exit_code == 0


def test_a_file_without_an_authority_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty.pem").write_text("")
    for name in ("missing.pem", "empty.pem"):
        with pytest.raises(ApiError) as caught:
            Client("https://127.0.0.1", ca=tmp_path / name)
        assert caught.value.code == credentials.NO_AUTHORITY
        assert name in str(caught.value)
