"""The API's descriptions are such that programs can be made of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from jsonschema import Draft202012Validator, ValidationError
from jsonschema.validators import validator_for
from schemathesis.specs.openapi.definitions import OPENAPI_30, OPENAPI_31

from service.app import create_app
from service.settings import Settings

# What OpenAPI 3.0 does not know, or knows as something else
NEWER = {
    *("const", "examples", "prefixItems", "propertyNames", "patternProperties", "contains"),
    *("if", "then", "else", "dependentSchemas", "unevaluatedProperties", "unevaluatedItems"),
    *("$defs", "$id", "$schema", "$anchor", "$comment", "contentMediaType", "contentEncoding"),
    *("contentSchema", "dependentRequired", "minContains", "maxContains", "itemSchema"),
}
# What the two versions know of a body
MEDIA_TYPE = {"schema", "example", "examples", "encoding"}


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("openapi"))
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as client:
        yield client


@pytest.fixture(scope="module", params=["/openapi.json", "/openapi-3.0.json"])
def document(request: pytest.FixtureRequest, http: TestClient) -> dict[str, Any]:
    found: dict[str, Any] = http.get(request.param).json()
    return found


def operations(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [each for path in document["paths"].values() for each in path.values()]


def schemas(document: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield every schema with its place, the outer ones first."""
    waiting = [(name, each) for name, each in document["components"]["schemas"].items()]
    for operation in operations(document):
        name = operation["operationId"]
        waiting += [(name, each["schema"]) for each in operation.get("parameters", ())]
        for holder in (operation.get("requestBody", {}), *operation["responses"].values()):
            contents = holder.get("content", {}).values()
            waiting += [(name, each["schema"]) for each in contents if "schema" in each]
    while waiting:
        place, schema = waiting.pop()
        yield place, schema
        if isinstance(schema, dict):
            inner = list(schema.get("properties", {}).items())
            inner += [(key, schema[key]) for key in ("items", "not") if key in schema]
            if isinstance(schema.get("additionalProperties"), dict):  # it may be a truth value
                inner.append(("additionalProperties", schema["additionalProperties"]))
            for key in ("anyOf", "oneOf", "allOf"):
                inner += [(key, each) for each in schema.get(key, ())]
            waiting += [(f"{place}.{key}", each) for key, each in inner]


def test_each_is_valid_in_its_own_version(document: dict[str, Any]) -> None:
    version = document["openapi"]
    rules = {"3.0.3": OPENAPI_30, "3.1.0": OPENAPI_31}[version]
    problems = sorted(f"{each.json_path}: {each.message}" for each in faults(rules, document))
    assert not problems, (version, problems[:5])
    if version == "3.1.0":  # a schema of 3.0 is checked with its document
        for _, schema in schemas(document):
            Draft202012Validator.check_schema(schema)


def faults(rules: dict[str, Any], document: dict[str, Any]) -> Iterator[Any]:
    yield from validator_for(rules)(rules).iter_errors(document)
    for operation in operations(document):
        for holder in (operation.get("requestBody", {}), *operation["responses"].values()):
            for content in holder.get("content", {}).values():
                if unknown := set(content) - MEDIA_TYPE:
                    yield ValidationError(f"{operation['operationId']} says {unknown}")
    licence = document["info"]["license"]
    if not {"url", "identifier"} & set(licence):
        yield ValidationError("the licence has neither url nor identifier")


def test_operations_have_short_names_of_their_own(document: dict[str, Any]) -> None:
    names = [each["operationId"] for each in operations(document)]
    assert len(set(names)) == len(names) > 60
    assert all(re.fullmatch(r"[a-z]+\.[a-z]+(_[a-z]+)*", name) for name in names), names
    assert {"uploads.create", "uploads.receive", "subjects.list", "rigs.change", "jobs.put"} <= set(
        names
    )


def test_nothing_is_a_list_of_one_kind_or_of_another(document: dict[str, Any]) -> None:
    """OpenAPI Generator names a C# getter of each, both ``GetList``."""
    for place, schema in schemas(document):
        several = [*schema.get("anyOf", ()), *schema.get("oneOf", ())]
        assert [each.get("type") for each in several].count("array") < 2, place


def test_what_may_be_left_out_is_no_null(document: dict[str, Any]) -> None:
    for operation in operations(document):
        for parameter in operation.get("parameters", ()):
            assert {"type": "null"} not in parameter["schema"].get("anyOf", ()), parameter
        for content in operation.get("requestBody", {}).get("content", {}).values():
            assert {"type": "null"} not in content["schema"].get("anyOf", ()), operation
            assert not content["schema"].get("nullable"), operation
    for name in ("NewSubject", "NewCapture", "NewJob", "Retry", "SubjectChange", "WebhookChange"):
        schema = document["components"]["schemas"][name]
        for key, each in schema["properties"].items():
            if key not in schema.get("required", ()):
                assert {"type": "null"} not in each.get("anyOf", ()), (name, key)
                assert not each.get("nullable"), (name, key)


def test_what_may_be_null_in_an_answer_says_so(document: dict[str, Any]) -> None:
    labels = document["components"]["schemas"]["CaptureChange"]["properties"]["labels"]
    started = document["components"]["schemas"]["JobItem"]["properties"]["started_at"]
    is_3_0 = document["openapi"].startswith("3.0")
    of_label = labels.get("additionalProperties") or next(
        iter(labels["patternProperties"].values())
    )
    for schema in (of_label, started):
        assert schema.get("nullable", False) is is_3_0, schema
        assert ({"type": "null"} in schema.get("anyOf", ())) is not is_3_0, schema


def test_the_older_one_says_nothing_that_3_0_does_not_know(http: TestClient) -> None:
    document = http.get("/openapi-3.0.json").json()
    assert document["openapi"] == "3.0.3"
    assert not {"webhooks", "jsonSchemaDialect"} & set(document)
    assert "itemSchema" not in str(document)
    for place, schema in schemas(document):
        assert isinstance(schema, dict), place
        assert not NEWER & set(schema), (place, schema)
        assert not isinstance(schema.get("type"), list), place
        assert schema.get("type") != "null", place
        assert "$ref" not in schema or len(schema) == 1, (place, schema)
        for word in ("exclusiveMinimum", "exclusiveMaximum"):
            assert isinstance(schema.get(word, True), bool), place
        assert schema.get("type") != "array" or "items" in schema, place


def test_both_describe_the_same_operations(http: TestClient) -> None:
    newer, older = (http.get(f"/openapi{suffix}.json").json() for suffix in ("", "-3.0"))
    assert newer["openapi"].startswith("3.1")
    assert [each["operationId"] for each in operations(newer)] == [
        each["operationId"] for each in operations(older)
    ]
    assert set(newer["components"]["schemas"]) == set(older["components"]["schemas"])


def test_they_are_asked_for_again_only_by_tag(http: TestClient) -> None:
    first = http.get("/openapi-3.0.json")
    again = http.get("/openapi-3.0.json", headers={"If-None-Match": first.headers["etag"]})
    assert first.headers["content-encoding"] == "gzip"
    assert (again.status_code, again.content) == (304, b"")


def test_each_is_named_where_people_look(http: TestClient) -> None:
    guide = (Path(__file__).parents[2] / "docs" / "guide" / "td-guide.md").read_text()
    for path in ("/openapi.json", "/openapi-3.0.json", "/api"):
        assert f"`{path}`" in guide, path
        assert http.get(path).status_code == 200, path
