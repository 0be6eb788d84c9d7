"""Temporary: the contracts give the verdicts of the JSON Schemas that they replace."""

import copy
import json
import random
from collections import Counter
from pathlib import Path

import jsonschema
import pytest

from solver.kinds import KINDS

ROOT = Path(__file__).parents[4]
OLD = ROOT / "service" / "kinds"
if not (OLD / "simulate.json").exists():
    pytest.skip("the old schemas are gone", allow_module_level=True)

DEFS = json.loads((OLD / "scenes" / "definitions.json").read_text())
SCHEMAS = {
    kind: {**json.loads((OLD / f"{kind}.json").read_text())["options"], "$defs": DEFS}
    for kind in KINDS
}
STRANGE = [
    None, True, False, 0, 1, -1, 2.0, 2.5, 1e300, -1e300, 10**400, "", "x", "a" * 65, [], {}, [1],
    [1, 2, 3], [1, 2, 3.5], [True, 1, 2], [1, 2, 3, 4], [1, 0, 0, 1, 0, 1], {"a": 1},
    {"kind": "fat"}, {"asset": "x"}, {"asset": 3}, {"box_mm": [1, 2, 3]}, {"ball_mm": 2},
    {"kind": "wind", "m_s": [1, 2, 3]}, {"kind": []}, {"kind": None}, {"kind": "wings"}, {"regions": ["x"]},
    {"spots": [1, "a", [1, 2, 3]], "radius_mm": 4}, {"spots": [1.5], "radius_mm": 4},
    {"time": 1}, {"at": 5.0}, {"time": "x", "kind": "time"}, 0.3, 5, 600, 601, 1000, 1001, 9.81,
]  # fmt: skip


class Generator:
    def __init__(self, schema, seed):
        self.root, self.r = schema, random.Random(seed)

    def make(self, schema):
        if schema is True:
            return self.r.choice(STRANGE)
        if "$ref" in schema:
            return self.make(self.root["$defs"][schema["$ref"].rsplit("/", 1)[1]])
        if "allOf" in schema:
            return self.kind(schema)
        for union in ("anyOf", "oneOf"):
            if union in schema:
                return self.make(self.r.choice(schema[union]))
        if "enum" in schema:
            return self.r.choice(schema["enum"])
        if "const" in schema:
            return schema["const"]
        kind = schema["type"]
        if isinstance(kind, list):
            kind = self.r.choice(kind)
        return getattr(self, kind)(schema)

    def kind(self, schema):
        each = self.r.choice(schema["allOf"])
        then = each["then"]
        made = self.object(then | {"properties": {k: v for k, v in then["properties"].items() if k != "kind"}})
        return {"kind": each["if"]["properties"]["kind"]["const"], **made}

    def object(self, schema):
        known, required = schema.get("properties", {}), schema.get("required", [])
        made = {
            name: self.make(rules)
            for name, rules in known.items()
            if name in required or self.r.random() < 0.5
        }
        if isinstance(schema.get("additionalProperties"), dict):
            for name in ("smile", "a b", "<x>"):
                if self.r.random() < 0.4:
                    made[name] = self.make(schema["additionalProperties"])
        return made

    def array(self, schema):
        low = schema.get("minItems", 0)
        count = self.r.randint(low, min(schema.get("maxItems", low + 3), low + 3))
        return [self.make(schema["items"]) for _ in range(count)]

    def bounds(self, schema):
        low = schema.get("minimum", schema.get("exclusiveMinimum", -1e4))
        return low, schema.get("maximum", 1e4)

    def number(self, schema):
        low, high = self.bounds(schema)
        edges = [low, high, (low + high) / 2, int((low + high) / 2), low + (high - low) * 0.01]
        return self.r.choice(edges) if self.r.random() < 0.9 else self.r.choice([low - 1, high + 1])

    def integer(self, schema):
        value = self.number(schema)
        return self.r.choice([int(value), float(int(value)), value])

    def string(self, schema):
        return self.r.choice(["x", "lip", "a" * schema.get("maxLength", 5)])

    def boolean(self, schema):
        return self.r.random() < 0.5

    def null(self, schema):
        return None

    def mutate(self, document):
        """Change one place of a document."""
        document = copy.deepcopy(document)
        places = list(self.places(document))
        holder, key = self.r.choice(places) if places else (None, None)
        if holder is None:
            return self.r.choice(STRANGE)
        choice = self.r.random()
        if choice < 0.2 and isinstance(holder, dict):
            del holder[key]
        elif choice < 0.3 and isinstance(holder, dict):
            holder[self.r.choice(["stranger", "kind", "time", "<asset>", "point"])] = self.r.choice(STRANGE)
        elif choice < 0.4 and isinstance(holder, list):
            holder.append(self.r.choice(STRANGE))
        elif isinstance(holder, list | dict):
            holder[key] = self.r.choice(STRANGE)
        return document

    def places(self, value):
        items = (
            value.items() if isinstance(value, dict)
            else enumerate(value) if isinstance(value, list) else ()
        )  # fmt: skip
        for key, each in list(items):
            yield value, key
            yield from self.places(each)


TEXTS = Counter()
SEED = __import__('os').environ.get('SEED', '')
NULLS = ("duration", "steps_per_frame")


def _without_new_nulls(document):
    if isinstance(document, dict) and isinstance(document.get("scene"), dict):
        scene = {k: v for k, v in document["scene"].items() if not (k in NULLS and v is None)}
        return {**document, "scene": scene}
    return document


def _root(path, name):
    return path.replace("$", name, 1)


@pytest.mark.parametrize("kind", KINDS)
def test_verdicts_are_those_of_the_old_schema(kind):
    old = jsonschema.Draft202012Validator(SCHEMAS[kind])
    new_schema = KINDS[kind].schema
    jsonschema.Draft202012Validator.check_schema(new_schema)
    printed = jsonschema.Draft202012Validator(new_schema)
    generator = Generator(SCHEMAS[kind], kind + SEED)
    verdicts = Counter()
    tries = 1500 if "scene" in SCHEMAS[kind]["properties"] else 600
    for number in range(tries):
        document = generator.make(SCHEMAS[kind])
        for _ in range(number % 3):
            document = generator.mutate(document)
        if not isinstance(document, dict):
            continue
        if document.get("symmetry") == 10**400:  # no float holds it: the old schema let it pass
            continue
        meant = _without_new_nulls(document)
        errors = list(old.iter_errors(meant))
        faults = KINDS[kind].faults(document)
        assert bool(faults) == bool(errors), (document, errors[:1], faults)
        assert printed.is_valid(document) == (not errors), (document, errors[:1], faults)
        verdicts[not errors] += 1
        if errors and not any("valid under" in error.message for error in errors):
            places = {_root(error.json_path, "options") for error in errors}
            strange = [f for f in faults if f.unknown and len(f.path) == 1]
            new_places = {fault.where for fault in faults if fault not in strange}
            if strange:
                new_places.add("options")
            assert new_places, (document, errors, faults)
            assert new_places <= places, (document, errors, faults)
            if len(errors) == len(faults) == 1 and not strange:
                TEXTS[errors[0].message.split(" ", 1)[-1], faults[0].message.split(" ", 1)[-1]] += 1
    assert min(verdicts.values()) > 50, verdicts

    for (a, b), count in TEXTS.items():
        if a != b:
            print(count, "|", a[:90], "|", b[:90])
