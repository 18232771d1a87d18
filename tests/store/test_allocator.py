"""What large answers took of memory is there for the next ones."""

import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
from roughmap_service.store.memory_limit import keep_freed
limit = int(sys.argv[1])
if limit:
    keep_freed(limit)
def answer():
    packed = bytearray(13 << 20)
    return len(b"".join((b"head", packed)))
answer()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    answer()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.parametrize(("limit", "kept"), [(0, False), (2 << 30, True), (64 << 20, False)])
def test_freed_memory_is_kept_in_proportion_to_the_limit(limit: int, kept: bool) -> None:
    """New pages from the system: ten answers of twice 13 MiB are 66,000 of them."""
    done = subprocess.run([sys.executable, "-c", FAULTS, str(limit)], capture_output=True, text=True, check=True)
    assert (int(done.stdout) < 1000) == kept
