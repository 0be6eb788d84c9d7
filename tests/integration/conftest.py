"""Every integration test runs twice: on SQLite, an embedded Valkey and a folder, and (`servers`)
on PostgreSQL, Redis and S3.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from myoface.stack import Stack
from tests.servers import UnavailableError, required
from tests.servers.production import Production, production
from tests.service_client import Studio, running

EMBEDDED = "embedded"
PARTS = [EMBEDDED, pytest.param("production", marks=pytest.mark.servers)]


@pytest.fixture(scope="session")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Production | str]:
    """Give the servers, or the reason why there are none."""
    try:
        with production(tmp_path_factory.mktemp("servers")) as found:
            yield found
    except UnavailableError as error:
        if required():
            raise
        yield str(error)


@pytest.fixture(scope="module", autouse=True, params=PARTS)
def parts(request: pytest.FixtureRequest) -> Iterator[Production | None]:
    """Make the settings of this module's stack those of the parts.

    A module's fixture that starts a service asks for it: else pytest keeps the service of the
    first parts for the second.
    """
    if request.param == EMBEDDED:
        yield None
        return
    found = request.getfixturevalue("servers")
    if isinstance(found, str):
        pytest.skip(found)
    with _environment(found):
        yield found


@pytest.fixture(scope="session")
def embedded_stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stack, Studio]]:
    with running(tmp_path_factory.mktemp("stack")) as both:
        yield both


@pytest.fixture(scope="module")
def stack_and_studio(
    parts: Production | None,
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[Stack, Studio]]:
    """Give a running stack, in which others leave subjects and jobs.

    All modules share the one of embedded parts: its five processes take seconds to start.
    """
    if parts is None:
        yield request.getfixturevalue("embedded_stack")
        return
    with running(tmp_path_factory.mktemp("stack")) as both:
        yield both


@pytest.fixture(autouse=True)
def own_parts(parts: Production | None) -> Iterator[None]:
    """Make the settings of a test's own service those of parts that are empty."""
    if parts is None:
        yield
        return
    with _environment(parts):
        yield


@contextmanager
def _environment(parts: Production) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in parts.fresh().items():
            patch.setenv(name, value)
        yield
