"""JSON Schemas of documents, as clients, the page and OpenAPI read them."""

from __future__ import annotations

from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class _Printed(GenerateJsonSchema):
    """Writes what may be null as one more type, and no titles that only repeat a name."""

    def field_title_should_be_set(self, _schema: Any) -> bool:
        return False

    def literal_schema(self, schema: core_schema.LiteralSchema) -> JsonSchemaValue:
        found = super().literal_schema(schema)
        if "enum" in found:
            found.pop("type", None)
        return found

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        found = self.generate_inner(schema["schema"])
        if "enum" in found:
            return {**found, "enum": [*found["enum"], None]}
        if isinstance(found.get("type"), str):
            return {**found, "type": [found["type"], "null"]}
        return super().nullable_schema(schema)


@cache
def json_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON Schema of a document; its members' order is the model's."""
    found = model.model_json_schema(schema_generator=_Printed)
    for name in ("title", "description"):  # of the class: the kind has better ones
        found.pop(name, None)
    return {"$schema": DIALECT, **found}
