"""A small JSON Schema validator: the part of the standard that the exported schemas use, and no more. A keyword that it
doesn't know is an error, so that no schema passes unread."""

import math
import re
from typing import Any

NOTES = {"$schema", "$defs", "title", "description", "default", "discriminator", "format", "writeOnly"}
TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "integer": (int,),
    "number": (int, float),
    "boolean": (bool,),
    "null": (type(None),),
}
CHECKED = {"$ref", "anyOf", "oneOf", "type", "enum", "const", "properties", "required", "additionalProperties"} | {
    *("propertyNames", "items", "prefixItems", "minItems", "maxItems", "minLength", "maxLength", "pattern"),
    *("minimum", "maximum", "exclusiveMinimum", "patternProperties", "maxProperties"),
}


def is_type(value: Any, name: str) -> bool:
    if isinstance(value, bool):
        return name == "boolean"
    if name == "integer" and isinstance(value, float):
        return value.is_integer()
    return isinstance(value, TYPES[name])


def faults(value: Any, schema: Any, root: dict[str, Any], at: str = "$") -> list[str]:
    """Everything in which an instance breaks a schema."""
    if isinstance(schema, bool):
        return [] if schema else [f"{at}: not allowed"]
    unknown = schema.keys() - NOTES - CHECKED
    assert not unknown, f"{at}: keywords {unknown} are not known"
    found: list[str] = []
    if "$ref" in schema:
        found += faults(value, at_pointer(root, schema["$ref"]), root, at)
    for word, wanted in (("anyOf", range(1, 99)), ("oneOf", range(1, 2))):
        if word in schema and sum(not faults(value, one, root, at) for one in schema[word]) not in wanted:
            found.append(f"{at}: {word}")
    if "type" in schema and not is_type(value, schema["type"]):
        return [*found, f"{at}: no {schema['type']}"]
    found += [f"{at}: {word}" for word, bad in simple(value, schema) if bad]
    if isinstance(value, dict):
        known = schema.get("properties", {})
        found += [f"{at}.{name}: missing" for name in schema.get("required", []) if name not in value]
        patterns = schema.get("patternProperties", {})
        for name, item in value.items():
            matching = [one for pattern, one in patterns.items() if re.search(pattern, name)]
            other = schema.get("additionalProperties", True) if not matching else True
            for one in (known.get(name, other), *matching):
                found += faults(item, one, root, f"{at}.{name}")
            found += faults(name, schema.get("propertyNames", True), root, f"{at}.{name} (its name)")
    if isinstance(value, list):
        first = schema.get("prefixItems", [])
        for number, item in enumerate(value):
            one = first[number] if number < len(first) else schema.get("items", True)
            found += faults(item, one, root, f"{at}[{number}]")
    return found


def simple(value: Any, schema: dict[str, Any]) -> list[tuple[str, bool]]:
    """The keywords that look at one value alone, and whether it breaks them."""
    number = value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    text = value if isinstance(value, str) else None
    length = len(value) if isinstance(value, list) else None
    return [
        ("enum", "enum" in schema and value not in schema["enum"]),
        ("const", "const" in schema and value != schema["const"]),
        ("minimum", number < schema.get("minimum", -math.inf)),
        ("maximum", number > schema.get("maximum", math.inf)),
        ("exclusiveMinimum", "exclusiveMinimum" in schema and number <= schema["exclusiveMinimum"]),
        ("minItems", length is not None and length < schema.get("minItems", 0)),
        ("maxItems", length is not None and length > schema.get("maxItems", math.inf)),
        ("maxProperties", isinstance(value, dict) and len(value) > schema.get("maxProperties", math.inf)),
        ("minLength", text is not None and len(text) < schema.get("minLength", 0)),
        ("maxLength", text is not None and len(text) > schema.get("maxLength", math.inf)),
        ("pattern", text is not None and "pattern" in schema and not re.search(schema["pattern"], text)),
    ]


def at_pointer(root: dict[str, Any], pointer: str) -> Any:
    """What a local reference names."""
    assert pointer.startswith("#/"), pointer
    found: Any = root
    for part in pointer[2:].split("/"):
        found = found[part]
    return found


def subschemas(schema: Any) -> list[dict[str, Any]]:
    """A schema and all schemas in it."""
    if isinstance(schema, bool):
        return []
    inner = [
        *(s for word in ("$defs", "properties", "patternProperties") for s in schema.get(word, {}).values()),
        *(s for word in ("anyOf", "oneOf", "prefixItems") for s in schema.get(word, [])),
        *(schema[word] for word in ("items", "additionalProperties", "propertyNames") if word in schema),
    ]
    return [schema, *(deeper for one in inner for deeper in subschemas(one))]
