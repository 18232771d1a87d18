"""`roughmap config`: show, check and describe the configuration."""

import json
from importlib.resources import files
from pathlib import Path

import click

from roughmap_service.cli.options import config_options, json_option, load

Settings = tuple[tuple[str, object], ...]


@click.group
def config() -> None:
    """roughmap config show

    Show, check or describe the configuration. Settings come from a TOML file (-c, or ./roughmap.toml), from the
    environment (for example ROUGHMAP_MAP__CELL_SIZE=0.2) and from --set; later ones override earlier ones.
    """


@config.command(short_help="configuration file to begin with")
def example() -> None:
    """roughmap config example > roughmap.toml

    Print a configuration file to begin with. It describes the sensor of `roughmap simulate`; replace it with yours.
    """
    click.echo(files("roughmap_service.cli").joinpath("example.toml").read_text(encoding="utf-8"), nl=False)


@config.command(short_help="effective settings and where each comes from")
@config_options
@json_option
def show(config_path: Path | None, settings: Settings, as_json: bool) -> None:
    """roughmap config show

    Show the effective settings and where each comes from. Secrets are hidden.
    """
    loaded = load(config_path, settings)
    values = flat(loaded.config.public_dict())
    rows = {key: (value, loaded.sources.get(key, "default")) for key, value in values.items()}
    if as_json:
        click.echo(json.dumps({key: {"value": value, "source": source} for key, (value, source) in rows.items()}))
        return
    texts = {key: f"{key} = {json.dumps(value)}" for key, (value, _) in rows.items()}
    width = min(max(map(len, texts.values()), default=0), 72)
    for key, (_, source) in rows.items():
        click.echo(f"{texts[key]:{width}}  # {source}")


@config.command(short_help="whether the configuration is valid")
@config_options
@json_option
def check(config_path: Path | None, settings: Settings, as_json: bool) -> None:
    """roughmap config check

    Check the configuration. Exit code 0 if it is valid; 2, with one line that names the error, if it is not.
    """
    from roughmap_schemas.config import configuration_digest

    loaded = load(config_path, settings)
    source = str(loaded.path) if loaded.path is not None else "no file, defaults"
    digest = configuration_digest(loaded.config)
    if as_json:
        click.echo(json.dumps({"ok": True, "path": source, "configuration_digest": digest}))
        return
    sensors = ", ".join(sorted(loaded.config.sensors)) or "none (only clouds in the map's own frame are accepted)"
    click.echo(f"{source}: ok; map {loaded.config.map.name!r}; sensors: {sensors}; configuration digest {digest}")


@config.command(short_help="JSON Schema: all settings, types, defaults")
def schema() -> None:
    """roughmap config schema

    Print the JSON Schema of the configuration: every setting with its type, default and allowed values.
    """
    from roughmap_schemas.export import texts

    click.echo(texts()["Config.json"], nl=False)


def flat(nested: dict[str, object], prefix: str = "") -> dict[str, object]:
    """Return nested tables as one table with dotted keys; an empty table is a value."""
    found: dict[str, object] = {}
    for key, value in nested.items():
        if isinstance(value, dict) and value:
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found
