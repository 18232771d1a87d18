"""`roughmap config`: what holds, whence it came, whether it is allowed, and what could be set."""

import json
from pathlib import Path

import click

from roughmap_service.cli.options import config_options, json_option, load

Settings = tuple[tuple[str, object], ...]


@click.group
def config() -> None:
    """roughmap config show

    Show, check or describe the configuration. It is put together from a TOML file (-c, else ./roughmap.toml),
    then the environment (ROUGHMAP_MAP__CELL_SIZE=0.2), then --set; each goes over the one before.
    """


@config.command(short_help="every setting that holds, and whence it came")
@config_options
@json_option
def show(config_path: Path | None, settings: Settings, as_json: bool) -> None:
    """roughmap config show

    Every setting that holds, and whence it came; secrets are hidden.
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


@config.command(short_help="whether a service could start with it")
@config_options
@json_option
def check(config_path: Path | None, settings: Settings, as_json: bool) -> None:
    """roughmap config check

    Exit 0 if a service could start with this configuration, 2 and one line if not.
    """
    from roughmap_schemas.config import configuration_digest

    loaded = load(config_path, settings)
    source = str(loaded.path) if loaded.path is not None else "no file, defaults"
    digest = configuration_digest(loaded.config)
    if as_json:
        click.echo(json.dumps({"ok": True, "path": source, "configuration_digest": digest}))
        return
    sensors = ", ".join(sorted(loaded.config.sensors)) or "none (only clouds in the map's own frame are taken)"
    click.echo(f"{source}: ok; map {loaded.config.map.name!r}; sensors: {sensors}; configuration digest {digest}")


@config.command(short_help="its JSON Schema: all that could be set")
def schema() -> None:
    """roughmap config schema

    The configuration's JSON Schema: every key, its type, its default and what is allowed.
    """
    from roughmap_schemas.export import texts

    click.echo(texts()["Config.json"], nl=False)


def flat(nested: dict[str, object], prefix: str = "") -> dict[str, object]:
    """Dotted keys for nested tables; a table without keys stands for itself."""
    found: dict[str, object] = {}
    for key, value in nested.items():
        if isinstance(value, dict) and value:
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found
