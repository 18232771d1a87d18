"""Log lines on stderr: JSON or text, with repeats counted instead of printed."""

import io
import json
import logging
import select
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

Format = Literal["auto", "json", "text"]

REPEAT_SECONDS, REPEATS = 60.0, 5
"""At most REPEATS lines of one kind (one robot, one reason) are printed in REPEAT_SECONDS; the others are counted."""

MAX_KINDS = 1024
"""The most kinds of lines that are counted: they contain robots' names, which come from outside."""

STALL_MS = 200
"""A reader that takes nothing for this long is not waited for again: a stopped terminal (Ctrl-S) or a collector that
hangs must not stop the map. The lines it does not take are lost, and counted."""


def note(logger: logging.Logger, level: int, event: str, text: str, *, always: bool = False, **fields: Any) -> None:
    """Log a notable event: ``event`` and ``fields`` for programs, ``text`` for people.

    With ``always`` it is printed however often it repeats, for a state that was entered or left.
    """
    logger.log(level, "%s", text, extra={"event": event, "fields": fields, "always": always})


def printable(text: str) -> str:
    """Return the text with its unprintable characters escaped (``\\x1b``).

    Log lines quote what robots and others send: a terminal would obey control characters, and a line break would forge
    a line.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def set_up(log_format: Format, level: str, stream: TextIO) -> None:
    """Send all log lines to ``stream``; "auto" is text on a terminal and JSON elsewhere."""
    as_text = log_format == "text" or (log_format == "auto" and stream.isatty())
    handler = Lines(stream)
    handler.setFormatter(TextFormatter() if as_text else JsonFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


@dataclass
class _Kind:
    """Lines of one kind since a moment: how many were printed, how many were held back, and the last of the latter."""

    since: float
    printed: int = 0
    held: int = 0
    last: logging.LogRecord | None = None


class Lines(logging.StreamHandler[TextIO]):
    """Prints a few lines of each kind at a time; the others are counted, and reported with the next or at the end."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._clock = clock
        self._kinds: OrderedDict[tuple[object, ...], _Kind] = OrderedDict()
        self._counting = threading.Lock()
        self._lost = 0
        self._poll: select.poll | None = None
        with suppress(io.UnsupportedOperation, ValueError):  # not a file: it takes everything
            number = stream.fileno()
            self._poll = select.poll()
            self._poll.register(number, select.POLLOUT)

    def emit(self, record: logging.LogRecord) -> None:
        """Print the record or count it."""
        fields = getattr(record, "fields", {})
        kind = (
            record.name,
            record.levelno,
            getattr(record, "event", record.msg),
            fields.get("robot"),
            fields.get("reason"),
        )
        if getattr(record, "always", False) or self._may_print(kind, record):
            self._write(record)

    def _write(self, record: logging.LogRecord) -> None:
        """Print the record, unless the stream takes nothing."""
        if self._poll is not None and not self._poll.poll(0 if self._lost else STALL_MS):
            self._lost += 1
            return
        if self._lost:
            text = f"{self._lost} log lines are lost: stderr was blocked"
            self._lost = 0
            super().emit(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))
        super().emit(record)

    def _may_print(self, kind: tuple[object, ...], record: logging.LogRecord) -> bool:
        with self._counting:
            now, known = self._clock(), self._kinds.get(kind)
            if known is None or now - known.since >= REPEAT_SECONDS:
                record.repeats = known.held if known is not None else 0
                self._kinds[kind] = known = _Kind(now)
                self._kinds.move_to_end(kind)
                while len(self._kinds) > MAX_KINDS:
                    self._kinds.popitem(last=False)
            if known.printed < REPEATS:
                known.printed += 1
                return True
            known.held, known.last = known.held + 1, record
            return False

    def close(self) -> None:
        """Print the last line of each kind that was counted, with the number of those before it."""
        with self._counting:
            kinds = list(self._kinds.values())
            self._kinds.clear()
        for kind in kinds:
            if kind.last is not None:
                kind.last.repeats = kind.held - 1
                self._write(kind.last)
        super().close()


class TextFormatter(logging.Formatter):
    """``12:00:03 WARNING text`` in local time, for a terminal."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's own name
        """Return the line with the number of its repeats that were not printed."""
        repeats = getattr(record, "repeats", 0)
        return printable(super().formatMessage(record)) + (f" (and {repeats} more like it before)" if repeats else "")


class JsonFormatter(logging.Formatter):
    """One JSON object per line: time (UTC), level, event if it is a notable one, message, and the event's fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": getattr(record, "event", None),
            "message": record.getMessage(),
            "repeats": getattr(record, "repeats", 0) or None,
            "error": self.formatException(record.exc_info) if record.exc_info else None,
        }
        line |= {name: value for name, value in getattr(record, "fields", {}).items() if name not in line}
        return json.dumps({name: value for name, value in line.items() if value is not None}, default=str)
