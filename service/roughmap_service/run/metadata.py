"""The metadata at the beginning of a log file, about the run that the file continues."""

from importlib.metadata import version

from roughmap import STATE_VERSION
from roughmap_schemas import Config, RunMetadata
from roughmap_service.run.run import Run


def file_metadata(run_id: str, run: Run, config: Config, *, epoch: int, index: int, created_ns: int) -> RunMetadata:
    """Return the metadata of the log file ``index``, in which ``run`` continues under ``config``."""
    return RunMetadata(
        run=run_id,
        created_ns=created_ns,
        epoch=epoch,
        index=index,
        first_input=run.input + 1,
        first_record=run.record + 1,
        base_sequence=run.map.sequence,
        base_digest=run.map.digest(),
        version=version("roughmap"),
        rules=run.settings.rules,
        state_version=STATE_VERSION,
        configuration=config.public_dict(),
    )
