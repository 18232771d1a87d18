"""The metadata record at the beginning of every log file."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, Self

import xxhash
from pydantic import Field, ValidationError

from roughmap_schemas.messages import BadJson, Hex32, Message, Number

RECORD_NAME: Final = "roughmap"
"""The name of the MCAP metadata record."""


CHECKSUM: Final = "checksum"


def _checksum(entries: Mapping[str, str]) -> str:
    """XXH3-128 over the entries, by name."""
    return xxhash.xxh3_128_hexdigest(json.dumps(sorted(entries.items())).encode())


class RunMetadata(Message):
    """Which part of which run a file holds, and the settings of its events.

    ``created_ns`` is the wall clock when the file was begun: it tells which of several runs is the newest, but does not
    order the files of one. ``index`` counts the run's files from 0. ``first_input`` is the number of the first input
    in the file, ``first_record`` that of its first input or event, both from 1 over the run. ``base_sequence`` and
    ``base_digest`` are the map's before the file's first event; the digest is "" if the file was begun because the one
    before it could no longer be written. ``rules`` is the version of the rules that decided on poses and clouds; their
    events hold what was decided. ``state_version`` is that of the cells, whose digests are in the file.
    ``configuration`` is without secrets.
    """

    run: Hex32
    created_ns: Number
    epoch: Number
    index: Number
    first_input: Number
    first_record: Annotated[int, Field(ge=1)]
    base_sequence: Number
    base_digest: Hex32 | Literal[""]
    version: str
    rules: Annotated[int, Field(ge=1)] = 1
    state_version: Annotated[int, Field(ge=1)] = 1
    configuration: dict[str, Any]

    def to_record(self) -> dict[str, str]:
        """Return the record's entries; MCAP metadata maps strings to strings."""
        values = self.model_dump(mode="json")
        entries = {
            name: json.dumps(value, allow_nan=False, sort_keys=True) if name == "configuration" else str(value)
            for name, value in values.items()
        }
        return {**entries, CHECKSUM: _checksum(entries)}

    @classmethod
    def from_record(cls, record: Mapping[str, str]) -> Self:
        """Read the record's entries; raises ``BadJson``, which names the first missing or invalid one.

        Unknown entries are ignored, so that older releases can read newer logs. The checksum is verified if there is
        one: MCAP itself has none over metadata records.
        """
        values: dict[str, object] = {name: record[name] for name in cls.model_fields if name in record}
        try:
            values["configuration"] = json.loads(record.get("configuration", ""))
            found = cls.model_validate(values)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise BadJson(f"metadata record roughmap: {first['loc'][0]}: {first['msg']}") from None
        except (ValueError, RecursionError):
            raise BadJson("metadata record roughmap: configuration: expected a JSON object") from None
        entries = {name: value for name, value in record.items() if name != CHECKSUM}
        if record.get(CHECKSUM, _checksum(entries)) != _checksum(entries):
            raise BadJson("metadata record roughmap: its checksum is wrong")
        return found
