"""How right is the map? One table of figures, each with its mark, and pictures of before and after.

    python tests/map_right/run.py DATA [--only PART] [--placed N] [--against REV] [--out FOLDER]

DATA holds hall_sequence.npz and offroad_tradr/ (CONTRIBUTING.md). Parts: hall, offroad, strays, people, placed,
confidence. ``before`` is surface "all", the paper's record of every return. ``--against REV`` adds what the ground
costs against an older version, which takes half an hour. Table and pictures are written to FOLDER as well.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import right_confidence
import right_costs
import right_field
import right_hall
import right_offroad
import right_person
import right_pictures
import right_placements
import right_recordings
import right_strays
from right_maps import SURFACES, Seen
from right_row import Row, lines

MODELS = ("cuboid", "ellipsoid", "point")
FIRST = MODELS[0]
"""The one by which what is put in is judged: it is the default."""

CELLS = 160_000
"""Of each kind of ground and pose error. All cells of a tile share the errors of its poses, so that with a tenth of
these cells the share that held is known to no better than the 3 points that it may be off."""


def say(text: str) -> None:
    """Progress, on standard error."""
    print(f"map-right: {text}", file=sys.stderr, flush=True)


class Judge:
    """The parts, by name; the recordings and the maps of them are read once."""

    def __init__(self, given: argparse.Namespace) -> None:
        self.seed, self.placed, self.out = given.seed, given.placed, given.out
        self.hall = right_recordings.hall(given.data)
        self.offroad = right_recordings.offroad(given.data)
        self.true = right_hall.truth(self.hall)
        self._read: dict[tuple[str, str, str], Seen] = {}
        self.parts: dict[str, Callable[[], list[Row]]] = {
            "hall": self.of_hall,
            "offroad": self.of_offroad,
            "strays": self.of_strays,
            "people": self.of_people,
            "placed": lambda: right_placements.rows(self.seed, self.placed, FIRST),
            "confidence": lambda: right_confidence.rows(self.seed, CELLS),
        }

    def of_hall(self) -> list[Row]:
        """Floor and obstacles; a picture."""
        title = "A hall's flat floor, 14 scans from one place"
        right_pictures.draw(self._both("hall", FIRST), title, self.out / "hall.png")
        before, after = ({model: self._seen("hall", surface, model) for model in MODELS} for surface in SURFACES)
        return right_hall.rows(self.hall, before, after, self.true)

    def of_offroad(self) -> list[Row]:
        """The driven track; a picture."""
        title = "A forest path, one sweep; blue: where the robot drove before it"
        path = self.out / "offroad.png"
        right_pictures.draw(self._both("offroad", FIRST), title, path, self.offroad.before)
        before, after = ({model: self._seen("offroad", surface, model) for model in MODELS} for surface in SURFACES)
        return right_offroad.rows(self.offroad, before, after)

    def of_strays(self) -> list[Row]:
        """In hall and on the path."""
        return [
            *right_strays.hall_rows(self.hall, self._both("hall", FIRST), self.true, self.seed, FIRST),
            *right_strays.offroad_rows(self.offroad, self._both("offroad", FIRST), self.seed, FIRST),
        ]

    def of_people(self) -> list[Row]:
        """In the hall, and before the sky."""
        return [
            *right_person.rows(self.hall, self.true, self.seed, 6, FIRST),
            *right_field.rows(self.seed, 3, FIRST),
        ]

    def _both(self, place: str, model: str) -> dict[str, Seen]:
        return {surface: self._seen(place, surface, model) for surface in SURFACES}

    def _seen(self, place: str, surface: str, model: str) -> Seen:
        key = place, surface, model
        if key not in self._read:
            self._read[key] = (
                right_hall.read(surface, self.hall.sweeps(), model)
                if place == "hall"
                else right_offroad.read(surface, self.offroad, model)
            )
        return self._read[key]


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA", help="the folder of recordings")
    parser.add_argument("--only", action="append", default=[], metavar="PART", help="this part; may be repeated")
    parser.add_argument("--placed", type=int, default=right_placements.PLACED, metavar="N", help="draws of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--against", metavar="REV", help="measure the costs against this older version as well")
    parser.add_argument("--out", type=Path, default=Path("right"), metavar="FOLDER", help="for table and pictures")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    judge = Judge(given)
    if unknown := [name for name in given.only if name not in judge.parts]:
        parser.error(f"--only {unknown[0]}: expected one of {', '.join(judge.parts)}")
    rows: list[Row] = []
    for name, part in judge.parts.items():
        if given.only and name not in given.only:
            continue
        begun = time.monotonic()
        made = part()
        missed = sum(row.met is False for row in made)
        say(f"{name}: {len(made)} figures, {missed} missed, {time.monotonic() - begun:.0f} s")
        rows += made
    if given.against:
        rows += right_costs.rows(given.against, given.data, given.out)
    text = "\n".join(lines(rows))
    (given.out / "right.md").write_text(text + "\n")
    record = {"seed": given.seed, "rows": [row.record() for row in rows]}
    (given.out / "right.json").write_text(json.dumps(record, allow_nan=False, indent=1))
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
