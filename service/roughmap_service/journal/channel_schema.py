"""JSON Schemas for the log's JSON channels, in the plain form that log viewers read."""

from typing import Any

from pydantic import TypeAdapter

PLAIN = ("integer", "number", "string", "boolean")


def plain_schema(adapter: TypeAdapter[Any], title: str) -> dict[str, Any]:
    """An object's schema that names the members whose values are of one plain type.

    Viewers such as Foxglove refuse a schema whose root is not an object, or that holds a union, a reference or a null
    anywhere. What is not named here is allowed, and shown, all the same; the full schemas are those in `schemas/json`.
    """
    full = adapter.json_schema(mode="serialization")
    definitions = full.get("$defs", {})
    variants = [_resolved(variant, definitions) for variant in full.get("oneOf", [full])]
    properties: dict[str, Any] = {}
    for variant in variants:
        for name, value in variant.get("properties", {}).items():
            kind = _resolved(value, definitions).get("type")
            if kind in PLAIN:
                properties[name] = {"type": kind}
    return {"title": title, "type": "object", "properties": properties}


def _resolved(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """A schema, or the definition that it refers to."""
    found: dict[str, Any] = definitions.get(schema.get("$ref", "").removeprefix("#/$defs/"), schema)
    return found
