"""The log's channels: the topic of each kind of message, and the schemas by which other tools read them."""

import json
from dataclasses import dataclass
from functools import cache
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from pydantic import TypeAdapter

from roughmap_schemas import EVENT, Keys, MessageFault, QueryRecord, UpdateRecord
from roughmap_schemas.kinds import Kind

PROTOBUF = {
    Kind.POINTS: PointCloud.DESCRIPTOR,
    Kind.ODOMETRY: Odometry.DESCRIPTOR,
    Kind.TRANSFORM: FrameTransform.DESCRIPTOR,
    Kind.GRIDS: Grid.DESCRIPTOR,
}
JSON: dict[Kind, tuple[str, TypeAdapter[Any]]] = {
    Kind.EVENTS: ("roughmap.Event", EVENT),
    Kind.UPDATES: ("roughmap.UpdateRecord", TypeAdapter(UpdateRecord)),
    Kind.QUERIES: ("roughmap.QueryRecord", TypeAdapter(QueryRecord)),
}

PLAIN = ("integer", "number", "string", "boolean")
"""The JSON types that `plain_schema` keeps."""


def input_topic(kind: Kind, robot: str, keys: Keys) -> str:
    """Return the topic of a robot's inputs of one kind."""
    return keys.form(kind).make(robot=robot)


def parse_topic(topic: str, keys: Keys) -> tuple[Kind, str] | None:
    """Return kind and robot of a topic that belongs to the run (robot "" for events), None for any other."""
    if topic == keys.events:
        return Kind.EVENTS, ""
    for kind, parse in (
        (Kind.POINTS, keys.parse_points),
        (Kind.ODOMETRY, keys.parse_odometry),
        (Kind.TRANSFORM, keys.parse_transform),
    ):
        try:
            return kind, parse(topic)
        except MessageFault:
            continue
    return None


@dataclass(frozen=True, slots=True)
class ChannelSchema:
    """How a channel's messages are encoded, and the schema record that describes them."""

    message_encoding: str
    name: str
    encoding: str
    data: bytes


@cache
def channel_schema(kind: Kind) -> ChannelSchema:
    """Return the schema of a kind's channels."""
    if kind in PROTOBUF:
        descriptor = PROTOBUF[kind]
        return ChannelSchema("protobuf", descriptor.full_name, "protobuf", file_descriptor_set(descriptor.file))
    name, adapter = JSON[kind]
    return ChannelSchema("json", name, "jsonschema", json.dumps(plain_schema(adapter, name)).encode())


def file_descriptor_set(file: FileDescriptor) -> bytes:
    """Return a protobuf file and everything it imports, imports first, as a serialised FileDescriptorSet."""
    files: dict[str, FileDescriptor] = {}

    def add(one: FileDescriptor) -> None:
        for needed in one.dependencies:
            add(needed)
        files[one.name] = one

    add(file)
    found = FileDescriptorSet()
    for one in files.values():
        one.CopyToProto(found.file.add())
    return found.SerializeToString()


def plain_schema(adapter: TypeAdapter[Any], title: str) -> dict[str, Any]:
    """Return an object's JSON Schema with only those members whose values have one plain type.

    Viewers such as Foxglove refuse a schema whose root is not an object, or that contains a union, a reference or a
    null anywhere. Members that are not listed are still allowed and shown. The full schemas are in `schemas/json`.
    """
    full = adapter.json_schema(mode="serialization")
    definitions = full.get("$defs", {})
    variants = [_resolve(variant, definitions) for variant in full.get("oneOf", [full])]
    properties: dict[str, Any] = {}
    for variant in variants:
        for name, value in variant.get("properties", {}).items():
            kind = _resolve(value, definitions).get("type")
            if kind in PLAIN:
                properties[name] = {"type": kind}
    return {"title": title, "type": "object", "properties": properties}


def _resolve(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return a schema, or the definition it refers to."""
    found: dict[str, Any] = definitions.get(schema.get("$ref", "").removeprefix("#/$defs/"), schema)
    return found
