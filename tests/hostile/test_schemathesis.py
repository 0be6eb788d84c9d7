"""What the OpenAPI document promises holds for requests made from it, good and bad."""

from __future__ import annotations

import logging
import random
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
import structlog

from service.settings import Settings
from tests.receiver import LOOPBACK
from tests.service_client import OFFSET_STREAM, Studio, served

if TYPE_CHECKING:  # else imported where it runs: every worker would wait a second for it
    from schemathesis import Case
    from schemathesis.generation import GenerationMode
    from schemathesis.schemas import APIOperation

EXAMPLES = 8
"""Of each operation, of valid and of invalid requests."""
CONFIG = {"checks": {"negative_data_rejection": {"expected-statuses": ["4xx"]}}}
SAYS_SO_BY_STATUS = {"/readyz"}  # 503 is what it is for: no broker runs here


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    folder: Path = tmp_path_factory.mktemp("schemathesis")
    plenty = {"rate_per_minute": 10**9, "max_open_uploads": 10**6, "webhook_allow": LOOPBACK}
    with served(Settings(data_dir=folder, **plenty)) as studio:
        yield studio
    structlog.configure(**before)


@pytest.fixture(scope="module")
def ids(studio: Studio) -> dict[str, str]:
    """Return the ids of one of everything."""
    subject = studio.subject()
    job = studio.submit("build_model", subject)
    rig, left = studio.pretend_rig(job, subject)
    webhook = studio.post("/v1/webhooks", url="http://127.0.0.1:9/")["id"]
    scans = [
        {
            "name": name,
            "role": "neutral" if name == "neutral" else "expression",
            "registered": False,
            "upload_id": studio.upload(f"{name}.obj", name.encode()),
        }
        for name in ("neutral", "frown")
    ]
    batch = studio.post("/v1/batches", subject={"name": "Kim"}, captures=scans)
    return {
        "subject_id": subject,
        "capture_id": studio.capture(subject, "smile"),
        "template_id": studio.post(
            "/v1/templates", name="mine", upload_id=studio.upload("a.npz", b"PK")
        )["id"],
        "upload_id": studio.upload("frown.obj", b"v 0 0 0\n"),
        "job_id": job,
        "rig_id": rig.id,
        "artifact_id": left.id,
        "webhook_id": webhook,
        "delivery_id": studio.post(f"/v1/webhooks/{webhook}/test")["id"],
        "batch_id": batch["id"],
        "key_id": studio.post("/v1/keys", name="x", scopes=["read"])["id"],
        "name": "rig.glb",
    }


def _document(studio: Studio) -> dict[str, Any]:
    """Return the OpenAPI document without its security: all requests here have a key."""
    document: dict[str, Any] = studio.get("/openapi.json")
    for operations in document["paths"].values():
        for operation in operations.values():
            operation.pop("security", None)
            for media in operation.get("requestBody", {}).get("content", {}).copy():
                if media == OFFSET_STREAM:  # a body that is no text: `test_uploads` sends it
                    del operation["requestBody"]
    return document


@pytest.mark.slow
@pytest.mark.parametrize("name", ["positive", "negative"])
def test_no_server_error_and_no_answer_that_is_not_documented(
    studio: Studio, ids: dict[str, str], name: str
) -> None:
    from hypothesis.errors import Unsatisfiable
    from schemathesis.config import SchemathesisConfig
    from schemathesis.generation import GenerationMode
    from schemathesis.openapi import from_dict

    mode = GenerationMode(name)
    faults: list[str] = []
    asked = 0
    schema = from_dict(_document(studio), config=SchemathesisConfig.from_dict(CONFIG))
    for result in schema.get_all_operations():
        operation = result.ok()
        if operation.path in SAYS_SO_BY_STATUS:
            continue
        try:
            asked += _hammer(studio, operation, ids, mode)
        except Unsatisfiable:
            assert mode is GenerationMode.NEGATIVE  # it takes nothing that could be wrong
        except (Exception, BaseExceptionGroup) as error:
            faults.append(f"{operation.label}: {error}")
    assert not faults, "\n\n".join(faults)
    assert asked > 100


def test_every_operation_but_the_probes_asks_for_a_key(studio: Studio) -> None:
    open_to_all = set()
    for path, operations in studio.get("/openapi.json")["paths"].items():
        for method, operation in operations.items():
            if "security" not in operation:
                open_to_all.add((method, path))
                continue
            answer = studio.http.request(
                method.upper(), path, headers={"Authorization": "Bearer myo_nothing"}
            )
            assert answer.status_code in (401, 422), (method, path, answer.status_code)
            assert "401" in operation["responses"], (method, path)
    assert {path for _, path in open_to_all} <= {"/healthz", "/readyz", "/v1/uploads"}


def _hammer(
    studio: Studio, operation: APIOperation, ids: dict[str, str], mode: GenerationMode
) -> int:
    from hypothesis import HealthCheck, Phase, given, seed, settings
    from schemathesis.generation import GenerationMode
    from schemathesis.specs.openapi.checks import positive_data_acceptance

    # valid by the document, and refused for what it means: no such kind of job, an address inside
    not_for_us = [positive_data_acceptance]
    asked = 0
    chance = random.Random(1)

    @seed(1)
    @settings(
        max_examples=EXAMPLES,
        database=None,
        deadline=None,
        phases=(Phase.explicit, Phase.generate),
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=mode))
    def once(case: Case) -> None:
        nonlocal asked
        asked += 1
        if mode is GenerationMode.POSITIVE and operation.method != "delete":
            for name in set(case.path_parameters or {}) & set(ids):
                if operation.path.endswith("/events") or chance.random() < 0.7:
                    case.path_parameters[name] = ids[name]
        case.validate_response(_ask(studio, case), excluded_checks=not_for_us)

    once()
    return asked


def _ask(studio: Studio, case: Case) -> httpx.Response:
    request = case.as_transport_kwargs(base_url="http://127.0.0.1")
    request.pop("cookies", None)
    if "data" in request:
        request["content"] = request.pop("data")
    answer: httpx.Response = studio.http.request(**request)
    return answer
