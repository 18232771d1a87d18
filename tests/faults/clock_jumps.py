"""A wall clock that jumps by an hour, both ways, under load and over restarts: log times rise, nothing expires."""

import random
from itertools import pairwise
from pathlib import Path

from load import Fleet, settings
from net import WAIT_S
from processes import Service, events_in, read_log, replay
from report import Trial
from shim import Shim

from roughmap_schemas import IntegrationEvent

HOUR_NS = 3600 * 10**9


def clock_jumps(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """``number`` jumps; a restart in the midst of them."""
    shim = Shim(folder)
    fleet = Fleet(rng.randrange(1 << 30))
    given = settings(shim.root, input={"max_wait": 60.0})
    offset = 0
    for jumps in (number // 2, number - number // 2):
        with Service(folder, environ=shim.environ, **given) as service:
            endpoints = service.ready()["endpoints"]
            with fleet.at_work(endpoints):
                for _ in range(jumps):
                    before = fleet.promised
                    offset = rng.choice([o for o in (-HOUR_NS, 0, HOUR_NS) if o != offset])
                    shim.set("clock_ns", offset)
                    trial.expect(fleet.wait_promised(before + 60), f"no receipts with the clock off by {offset} ns")
                    trial.once("forward" if offset > 0 else "back")
            with fleet.at_work(endpoints, most=2, asking=False) as done:
                trial.expect(done.wait(WAIT_S), f"not acknowledged: {fleet.left()}")
            trial.expect(service.stop() == 0, f"the end: {service.err[-3:]}")
        offset = -HOUR_NS  # between the starts it is set back for good
        shim.set("clock_ns", offset)
    log = shim.root / "log"
    times = [one.log_time for one in read_log(log)]
    falls = sum(after <= before for before, after in pairwise(times))
    trial.expect(not falls, f"log times fall {falls} times in {len(times)} messages")
    outcomes = {str(e.outcome) for e in events_in(log) if isinstance(e, IntegrationEvent)}
    trial.expect(outcomes == {"integrated"}, f"outcomes {outcomes}")
    for broken in fleet.broken_promises(log):
        trial.expect(False, broken)
    code, verdict = replay(log)
    trial.expect(code == 0, f"replay: {verdict}")
