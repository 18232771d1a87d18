"""Writes the JSON Schemas of the contract, for programs in other languages.

``python -m roughmap_schemas.export`` writes them to schemas/json, or to ``--folder``. With ``--check`` it writes
nothing and lists the files that are out of date.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, TypeAdapter

from roughmap_schemas.config import Config
from roughmap_schemas.events import EVENT
from roughmap_schemas.messages import (
    CellAnswer,
    ControlAnswer,
    MapStatus,
    QueryError,
    QueryRecord,
    Receipt,
    TileInfo,
    UpdateRecord,
)
from roughmap_schemas.reasons import QueryCode, Reason
from roughmap_schemas.run_metadata import RunMetadata

FOLDER: Final = Path(__file__).resolve().parents[1] / "json"
DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"

MODELS: Final[Mapping[str, type[BaseModel] | TypeAdapter[Any]]] = {
    "CellAnswer": CellAnswer,
    "Config": Config,
    "ControlAnswer": ControlAnswer,
    "Event": EVENT,
    "MapStatus": MapStatus,
    "QueryCode": TypeAdapter(QueryCode),
    "QueryError": QueryError,
    "QueryRecord": QueryRecord,
    "Reason": TypeAdapter(Reason),
    "Receipt": Receipt,
    "RunMetadata": RunMetadata,
    "TileInfo": TileInfo,
    "UpdateRecord": UpdateRecord,
}
"""The exported models, by file name and title."""


def json_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema of one model as it is written; of ``Config``, as it may be read."""
    kind = MODELS[name]
    mode: Any = "validation" if name == "Config" else "serialization"
    schema = kind.json_schema(mode=mode) if isinstance(kind, TypeAdapter) else kind.model_json_schema(mode=mode)
    return {"$schema": DIALECT, "title": name, **{key: value for key, value in schema.items() if key != "title"}}


def texts() -> dict[str, str]:
    """Return the text of each file, by name."""
    return {
        f"{name}.json": json.dumps(_plain(json_schema(name)), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        for name in MODELS
    }


def _plain(value: Any) -> Any:
    """Replace infinities, which JSON lacks, by the texts that the settings accept for them."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if value in (float("inf"), float("-inf")) else value


def stale(folder: Path) -> list[str]:
    """Return the names of files that are missing, differ from their model or have no model."""
    wanted = texts()
    found = {path.name: path.read_text(encoding="utf-8") for path in folder.glob("*.json")}
    return sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))


def write(folder: Path) -> list[str]:
    """Bring the folder up to date and return the names of the files that changed."""
    changed = stale(folder)
    wanted = texts()
    folder.mkdir(parents=True, exist_ok=True)
    for name in changed:
        if name in wanted:
            (folder / name).write_text(wanted[name], encoding="utf-8")
        else:
            (folder / name).unlink()
    return changed


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m roughmap_schemas.export", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a file is not up to date")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="folder of the files (default: %(default)s)")
    given = parser.parse_args(arguments)
    check, folder = given.check, given.folder
    names = stale(folder) if check else write(folder)
    for name in names:
        sys.stderr.write(f"{folder / name}: {'out of date' if check else 'written'}\n")
    if check and names:
        sys.stderr.write("to update: python -m roughmap_schemas.export\n")
    return 1 if check and names else 0


if __name__ == "__main__":
    sys.exit(main())
