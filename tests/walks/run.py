"""make walks

Simulated robots with one fault each send to a service: is the right fault named in its log, in its health and by
`roughmap doctor`, each within 10 s; does the problem end after the fault; do the settings that doctor gives mend it?
Then a recording is sent in many ways: nothing of it may be lost. Prints a table; exits 1 by what is not so.
"""

import argparse
import json
import random
import shutil
import sys
import tempfile
from pathlib import Path

import walks_paths  # noqa: F401 - before what it makes importable
from feed_ways import QUICK, SLOW, differences, feed_all, record
from walk_faults import FAULTS
from walk_paste import pasted, try_pasted
from walk_report import as_json, findings, table
from walk_sender import draw
from walk_trial import walk_all

LIMIT_S = 10.0
RECORDING_S = 8.0

LANE_M = 15.0
"""Between two robots' ways."""


def main() -> int:
    """Parse, walk, tell."""
    parser = argparse.ArgumentParser(prog="make walks", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=FAULTS, metavar="NAME", help=f"of {', '.join(FAULTS)}")
    parser.add_argument("--seed", type=int, default=None, help="what all chances come from; printed if not given")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table and all words said there")
    asked = parser.parse_args()
    seed = random.SystemRandom().randrange(1 << 32) if asked.seed is None else asked.seed
    print(f"seed {seed}: again with ARGS='--seed {seed}'", file=sys.stderr)
    names = asked.only or list(FAULTS)
    folder = Path(tempfile.mkdtemp(prefix="roughmap-walks-"))
    walks = [draw(name, seed, LANE_M * lane) for lane, name in enumerate(names)]
    say = lambda text: print(f"{text} ...", file=sys.stderr, flush=True)  # noqa: E731
    walk_all(folder / "first", walks, LIMIT_S, say)
    if advised := pasted(walks):
        say(f"with doctor's settings: {', '.join(walk.name for walk in advised)}")
        try_pasted(folder / "pasted", advised, LIMIT_S)
    found = findings(walks, LIMIT_S)
    if asked.only is None:
        say(f"a recording of {RECORDING_S:g} s in {len(QUICK | SLOW)} ways")
        found += differences(feed_all(folder / "fed", record(seed, RECORDING_S)))
    print(table(walks, LIMIT_S))
    if asked.json is not None:
        asked.json.write_text(json.dumps({"seed": seed, "walks": as_json(walks), "found": found}, indent=2))
    for line in found:
        print(f"FOUND {line}")
    if not found:
        shutil.rmtree(folder)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
