"""The description of the API for programs: OpenAPI 3.1, and 3.0 for generators that know no later.

What may be left out of a request is described as such: that a null does the same is no type of its
own, of which generators would make one. In 3.0 a null is ``nullable``, and words that it does not
know are put in its own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import cache
from typing import Any

from fastapi import FastAPI, Response
from fastapi.routing import APIRoute

from service import errors
from service.page.routes import AcceptEncoding, IfNoneMatch, StaticFile, send_static

JsonObject = dict[str, Any]
NEWER = "/openapi.json"
OLDER = "/openapi-3.0.json"
NULL = {"type": "null"}
SEVERAL = ("anyOf", "oneOf", "allOf")
REFERENCE = "#/components/schemas/"
# Words of JSON Schema that 3.0 lacks, and that say nothing which a generator needs
UNKNOWN_TO_3_0 = ("propertyNames", "contentMediaType", "contentEncoding")


def operation_id(route: APIRoute) -> str:
    """Return an operation's name, such as ``subjects.list``: its tag and what it does there."""
    name = "list" if route.name == "index" else route.name
    if route.methods == {"HEAD"} and name != "offset":  # beside the GET of the same function
        name += "_head"
    return ".".join([*map(str, route.tags[:1]), name])


def install(app: FastAPI) -> None:
    """Describe ``app`` at its paths, when somebody asks: it takes half a second."""
    describe = app.openapi

    @cache
    def newer() -> JsonObject:
        return _complete(describe())

    @cache
    def older() -> JsonObject:
        return as_3_0(newer())

    app.openapi = newer  # type: ignore[method-assign]
    for path, document in ((NEWER, newer), (OLDER, older)):
        app.add_api_route(path, _sender(document), methods=["GET", "HEAD"], include_in_schema=False)


def _sender(document: Callable[[], JsonObject]) -> Callable[..., Response]:
    @cache
    def packed_document() -> StaticFile:
        return StaticFile.of(json.dumps(document()).encode(), "application/json")

    def send(accept_encoding: AcceptEncoding = "", if_none_match: IfNoneMatch = "") -> Response:
        return send_static(packed_document(), accept_encoding, if_none_match)

    return send


def _complete(document: JsonObject) -> JsonObject:
    """Complete FastAPI's description: problems of any request, and what may be absent."""
    schemas = document["components"]["schemas"]
    schemas["ProblemDocument"] = errors.ProblemDocument.model_json_schema()
    of_keys = _by_text(errors.problems(401, 403, 429))
    bodies = _by_text(errors.problems(400, 408, 413))
    asked: set[str] = set()
    for operation in _operations(document):
        if "requestBody" in operation:
            operation["responses"] = bodies | operation["responses"]
            for content in operation["requestBody"]["content"].values():
                content["schema"] = _without_null(content.get("schema", {}))
                asked |= _references(content["schema"], schemas)
        for content in _contents(operation):
            # FastAPI describes each event of a stream, in a word of 3.2. Before it some tools take
            # a schema for the whole text's and some for each event's: any will do for both.
            if content.pop("itemSchema", None) is not None:
                content["schema"] = {}
        if "security" in operation:
            operation["responses"] = of_keys | operation["responses"]
        for parameter in operation.get("parameters", ()):
            if not parameter.get("required"):
                parameter["schema"] = _without_null(parameter["schema"])
    for name in asked:
        required = schemas[name].get("required", ())
        for key, schema in schemas[name].get("properties", {}).items():
            if key not in required:
                schemas[name]["properties"][key] = _without_null(schema)
    return document


def as_3_0(document: JsonObject) -> JsonObject:
    """Return a description in OpenAPI 3.1 as one in 3.0."""
    found = deepcopy(document)
    found["openapi"] = "3.0.3"
    for operation in _operations(found):
        for holder in (*operation.get("parameters", ()), *_contents(operation)):
            if "schema" in holder:
                holder["schema"] = _schema_3_0(holder["schema"])
    schemas = found["components"]["schemas"]
    found["components"]["schemas"] = {name: _schema_3_0(each) for name, each in schemas.items()}
    return found


def _schema_3_0(schema: JsonObject | bool) -> JsonObject:
    if isinstance(schema, bool):
        return {} if schema else {"not": {}}
    found = {key: value for key, value in schema.items() if key not in UNKNOWN_TO_3_0}
    is_nullable = NULL in found.get("anyOf", ())
    found = _without_null(found)
    for each in found.pop("patternProperties", {}).values():
        found["additionalProperties"] = each  # of members whose names it cannot describe
    for key in SEVERAL:
        if key in found:
            found[key] = [_schema_3_0(each) for each in found[key]]
    for key in ("items", "additionalProperties"):
        if isinstance(found.get(key), dict):
            found[key] = _schema_3_0(found[key])
    if "properties" in found:
        found["properties"] = {
            name: _schema_3_0(each) for name, each in found["properties"].items()
        }
    if "const" in found:
        found["enum"] = [found.pop("const")]
    if examples := found.pop("examples", None):
        found["example"] = examples[0]
    for end in ("Minimum", "Maximum"):
        if (limit := found.pop(f"exclusive{end}", None)) is not None:
            found |= {end.lower(): limit, f"exclusive{end}": True}
    if "$ref" in found and (len(found) > 1 or is_nullable):  # 3.0 does not look beside a reference
        found = {"allOf": [{"$ref": found.pop("$ref")}], **found}
    return found | ({"nullable": True} if is_nullable else {})


def _without_null(schema: JsonObject) -> JsonObject:
    """Return a schema that takes the same values except null."""
    if NULL not in schema.get("anyOf", ()):
        return schema
    rest = [each for each in schema["anyOf"] if each != NULL]
    beside = {key: value for key, value in schema.items() if key != "anyOf"}
    return {**rest[0], **beside} if len(rest) == 1 else {"anyOf": rest, **beside}


def _references(schema: Any, schemas: Mapping[str, Any]) -> set[str]:
    """Return the names of all schemas that one refers to, and those to which they do."""
    found: set[str] = set()
    waiting = [schema]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict):
            name = str(each.get("$ref", "")).removeprefix(REFERENCE)
            if name in schemas and name not in found:
                found.add(name)
                waiting.append(schemas[name])
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each
    return found


def _operations(document: JsonObject) -> Iterator[JsonObject]:
    for operations in document["paths"].values():
        yield from operations.values()


def _contents(operation: JsonObject) -> Iterator[JsonObject]:
    """Yield what an operation says of each type of its body and its answers."""
    for holder in (operation.get("requestBody", {}), *operation["responses"].values()):
        yield from holder.get("content", {}).values()


def _by_text(answers: Mapping[int | str, JsonObject]) -> JsonObject:
    return {str(status): answer for status, answer in answers.items()}
