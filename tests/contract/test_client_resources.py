"""The client's values are those that the API shows."""

from __future__ import annotations

import dataclasses
from typing import Any, get_args

import pytest

from myoface import resources, tenant
from myoface.client.jobs import read_frame
from myoface.errors import ApiError
from myoface.values import Resource
from service.access.principal import Scope
from service.app import create_app
from service.queue.states import FINAL, State
from service.settings import Settings

SHAPES = {
    resources.JobKind: "KindView",
    resources.Upload: "UploadView",
    resources.Template: "TemplateView",
    resources.Subject: "SubjectView",
    resources.Capture: "CaptureView",
    resources.Artifact: "ArtifactView",
    resources.Job: "JobView",
    resources.Cancel: "CancelView",
    resources.Result: "Result",
    resources.LogLine: "LogLineView",
    resources.Frame: "FrameView",
    resources.Rig: "RigView",
    resources.Batch: "BatchView",
    resources.BatchCheck: "CheckStepView",
    resources.BatchFit: "FitStepView",
    resources.BatchScan: "ScanView",
    tenant.Me: "Me",
    tenant.Use: "Use",
    tenant.Usage: "Usage",
    tenant.Key: "KeyView",
    tenant.NewKey: "KeyWithText",
    tenant.Deletion: "DeletionView",
    tenant.AuditEntry: "AuditEntryView",
    tenant.Webhook: "WebhookView",
    tenant.NewWebhook: "WebhookWithSecret",
    tenant.Delivery: "DeliveryView",
}


@pytest.fixture(scope="module")
def schemas(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("data"))
    found: dict[str, Any] = create_app(settings).openapi()["components"]["schemas"]
    return found


@pytest.mark.parametrize("resource", SHAPES, ids=lambda resource: resource.__name__)
def test_every_field_is_shown(resource: type[Resource], schemas: dict[str, Any]) -> None:
    assert {field.name for field in dataclasses.fields(resource)} <= set(
        schemas[SHAPES[resource]]["properties"]
    )


@pytest.mark.parametrize("activations", [[[0.5], [0]], [[1.0, 0, 0, 1, 0, 1]]], ids=str)
def test_frames_are_read_in_rows(activations: list[Any]) -> None:
    numbers = ("frame", "mean_mm", "p95_mm", "max_mm", "coverage", "inverted", "iterations")
    values: dict[str, Any] = {"status": "predicted", "jaw": [0.0], "head": [0.0]}
    values |= dict.fromkeys((*numbers, "seconds"), 0)
    frame = read_frame({**values, "activations": activations})
    assert isinstance(frame, resources.Frame)
    assert frame.activations == activations
    with pytest.raises(ApiError, match="activations"):
        read_frame({**values, "activations": [0.5]})


def test_scopes_and_states_are_the_service_s() -> None:
    assert set(get_args(tenant.Scope)) == {str(scope) for scope in Scope}
    assert set(get_args(resources.State)) == {str(state) for state in State}
    assert {str(state) for state in FINAL} == resources.FINAL_STATES
