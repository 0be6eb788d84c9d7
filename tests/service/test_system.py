"""Routes of the service itself, without workers and broker."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from service.settings import Settings
from tests.service_client import Studio, served


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("system"))) as studio:
        yield studio


def test_the_old_path_of_the_kinds_answers_and_names_the_new_one(studio: Studio) -> None:
    kinds, solvers = studio.http.get("/v1/kinds"), studio.http.get("/v1/solvers")
    assert kinds.status_code == solvers.status_code == 200
    assert kinds.json()["items"]
    assert solvers.json() == kinds.json()
    assert solvers.headers["Deprecation"].startswith("@")
    assert solvers.headers["Link"] == '</v1/kinds>; rel="successor-version"'
    assert "Deprecation" not in kinds.headers


def test_only_the_new_path_is_described(studio: Studio) -> None:
    paths = studio.get("/openapi.json")["paths"]
    assert "/v1/kinds" in paths
    assert "/v1/solvers" not in paths


@pytest.mark.parametrize("path", ["/v1/kinds", "/v1/solvers"])
def test_both_paths_need_a_key(path: str, studio: Studio) -> None:
    assert studio.http.get(path, headers={"Authorization": ""}).status_code == 401
