"""One target for some seconds, in a process of its own: ``drive.py TARGET SECONDS FOLDER``. An input that is a finding
is left in FOLDER, and the exit is not 0. The last lines on stderr are libFuzzer's figures, or ours in the same form."""

import importlib.util
import sys
import tempfile
import time
from pathlib import Path

INSTRUMENTED = ["roughmap_schemas", "roughmap_client", "roughmap_ros", "roughmap_service", "mcap"]

RSS_MIB = 2048
INPUT_SECONDS = 20

HAS_ATHERIS = importlib.util.find_spec("atheris") is not None


def by_coverage(target: str, seconds: float, folder: Path) -> None:
    """Guided by the branches that an input takes; doesn't come back."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED, enable_loader_override=False):
        from targets import CORPUS, MAX_BYTES, TARGETS

    with tempfile.TemporaryDirectory(prefix="roughmap-corpus-") as grown:  # the repository's corpus stays small
        options = {
            "max_total_time": int(seconds),
            "max_len": MAX_BYTES,
            "rss_limit_mb": RSS_MIB,
            "timeout": INPUT_SECONDS,
            "artifact_prefix": f"{folder}/{target}-",
            "print_final_stats": 1,
            "verbosity": 1,
        }
        settings = [f"-{name}={value}" for name, value in options.items()]
        atheris.Setup([sys.argv[0], grown, str(CORPUS / target), *settings], TARGETS[target])
        atheris.Fuzz()


def by_hypothesis(target: str, seconds: float, folder: Path) -> None:
    """Not guided by coverage: what the corpus holds, changed."""
    from hypothesis import HealthCheck, given, settings
    from mutations import mutated
    from targets import TARGETS

    until = time.monotonic() + seconds
    runs = 0
    last = b""

    @settings(max_examples=500, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(mutated(target))
    def some(payload: bytes) -> None:
        nonlocal runs, last
        runs += 1
        last = payload
        TARGETS[target](payload)

    try:
        while time.monotonic() < until:
            some()
    except BaseException:
        (folder / f"{target}-crash").write_bytes(last)  # the last one tried is the smallest that fails
        raise
    finally:
        print(f"stat::number_of_executed_units: {runs}", file=sys.stderr)


if __name__ == "__main__":
    drive = by_coverage if HAS_ATHERIS else by_hypothesis
    drive(sys.argv[1], float(sys.argv[2]), Path(sys.argv[3]))
