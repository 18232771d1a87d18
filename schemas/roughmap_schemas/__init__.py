"""The contract: messages, key expressions, codecs and configuration that the service and its clients share.

keys.py, kinds.py, encodings.py                key expressions, kinds of messages, Zenoh encodings
cloud.py, odometry.py, transform.py, grid.py   codecs of protobuf messages; wire.py, geometry.py: what they share
point_times.py                                 the times of a cloud's points
messages.py, events.py, run_metadata.py        messages in JSON, events, the metadata of a log file
selectors.py, parameters.py, layers.py         queries: selectors, their parameters, the names of layers
reasons.py, faults.py                          reasons and codes; errors
config.py, sections.py, values.py              the configuration, its sections, its types; config_load.py reads it
contract.py, export.py                         the version of the contract; its JSON Schemas
"""

from roughmap_schemas.cloud import Cloud, decode_cloud, encode_cloud
from roughmap_schemas.config import Config, configuration_digest
from roughmap_schemas.config_load import LoadedConfig, config_from, load_config
from roughmap_schemas.contract import CONTRACT_VERSION
from roughmap_schemas.encodings import check_encoding, json_encoding
from roughmap_schemas.events import (
    EVENT,
    CheckpointEvent,
    Event,
    ForgetEvent,
    IntegrationEvent,
    ResetEvent,
    SensorTimeEvent,
    decode_event,
    encode_event,
)
from roughmap_schemas.faults import ConfigFault, ContractError, Fault, MessageFault, QueryFault, UnknownEventKind
from roughmap_schemas.grid import Grid, decode_grid, encode_grid
from roughmap_schemas.keys import Keys
from roughmap_schemas.layers import LAYERS, LIMIT_NAMES, Surface
from roughmap_schemas.messages import (
    BadJson,
    CellAnswer,
    CellEntry,
    CellState,
    ControlAnswer,
    MapStatus,
    QueryError,
    QueryRecord,
    Receipt,
    TileInfo,
    UpdateRecord,
    model_bytes,
    parse_model,
)
from roughmap_schemas.odometry import Odometry, decode_odometry, encode_odometry
from roughmap_schemas.point_times import NO_TIMES, TimeField, TimeForm, contract_timed, timed
from roughmap_schemas.reasons import INTEGRATED, CloudReason, PointReason, PoseReason, QueryCode, Reason, Refusal
from roughmap_schemas.robot_sections import SensorConfig
from roughmap_schemas.run_metadata import RunMetadata
from roughmap_schemas.selectors import CellsQuery, ForgetQuery, RegionQuery, TileQuery
from roughmap_schemas.transform import Transform, decode_transform, encode_transform

__all__ = [
    "CONTRACT_VERSION",
    "EVENT",
    "INTEGRATED",
    "LAYERS",
    "LIMIT_NAMES",
    "NO_TIMES",
    "BadJson",
    "CellAnswer",
    "CellEntry",
    "CellState",
    "CellsQuery",
    "CheckpointEvent",
    "Cloud",
    "CloudReason",
    "Config",
    "ConfigFault",
    "ContractError",
    "ControlAnswer",
    "Event",
    "Fault",
    "ForgetEvent",
    "ForgetQuery",
    "Grid",
    "IntegrationEvent",
    "Keys",
    "LoadedConfig",
    "MapStatus",
    "MessageFault",
    "Odometry",
    "PointReason",
    "PoseReason",
    "QueryCode",
    "QueryError",
    "QueryFault",
    "QueryRecord",
    "Reason",
    "Receipt",
    "Refusal",
    "RegionQuery",
    "ResetEvent",
    "RunMetadata",
    "SensorConfig",
    "SensorTimeEvent",
    "Surface",
    "TileInfo",
    "TileQuery",
    "TimeField",
    "TimeForm",
    "Transform",
    "UnknownEventKind",
    "UpdateRecord",
    "check_encoding",
    "config_from",
    "configuration_digest",
    "contract_timed",
    "decode_cloud",
    "decode_event",
    "decode_grid",
    "decode_odometry",
    "decode_transform",
    "encode_cloud",
    "encode_event",
    "encode_grid",
    "encode_odometry",
    "encode_transform",
    "json_encoding",
    "load_config",
    "model_bytes",
    "parse_model",
    "timed",
]
