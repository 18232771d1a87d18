"""Log lines on stderr: one a notable event, as JSON or for reading, repeats counted instead of told."""

import json
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

Format = Literal["auto", "json", "text"]

REPEAT_SECONDS = 60.0
"""Of lines of one kind (and one robot) one is told in so many seconds, and how many were not."""

MAX_KINDS = 1024
"""Kinds of lines that are remembered for that: robots' names come from outside."""


def note(logger: logging.Logger, level: int, event: str, text: str, *, always: bool = False, **fields: Any) -> None:
    """Log a notable event: its name and plain values for programs, ``text`` for people. ``always``: each one is told,
    as of a state that was entered or left."""
    logger.log(level, "%s", text, extra={"event": event, "fields": fields, "always": always})


def set_up(log_format: Format, level: str, stream: TextIO) -> None:
    """Send all log lines to ``stream``; "auto" is text on a terminal and JSON elsewhere."""
    as_text = log_format == "text" or (log_format == "auto" and stream.isatty())
    handler = Lines(stream)
    handler.setFormatter(TextFormatter() if as_text else JsonFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


class Lines(logging.StreamHandler[TextIO]):
    """Writes each line once a while; those between are counted, and told with the next one or at the end."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._clock = clock
        self._told: OrderedDict[tuple[object, ...], tuple[float, int, logging.LogRecord]] = OrderedDict()
        self._counting = threading.Lock()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, or count it."""
        fields = getattr(record, "fields", {})
        kind = record.name, record.levelno, getattr(record, "event", record.msg), fields.get("robot")
        if not getattr(record, "always", False):
            with self._counting:
                now = self._clock()
                since, held, _ = self._told.get(kind, (float("-inf"), 0, record))
                if now - since < REPEAT_SECONDS:
                    self._told[kind] = since, held + 1, record
                    return
                self._told[kind] = now, 0, record
                self._told.move_to_end(kind)
                while len(self._told) > MAX_KINDS:
                    self._told.popitem(last=False)
            record.repeats = held
        super().emit(record)

    def close(self) -> None:
        """Tell the last line of each kind that was counted, and how many there were before it."""
        with self._counting:
            left = [(held, record) for _, held, record in self._told.values() if held]
            self._told.clear()
        for held, record in left:
            record.repeats = held - 1
            super().emit(record)
        super().close()


class TextFormatter(logging.Formatter):
    """``12:00:03 WARNING text``, in local time, for a person at a terminal."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's own name
        """The line, with how many like it were not told."""
        repeats = getattr(record, "repeats", 0)
        return super().formatMessage(record) + (f" (and {repeats} more like it before)" if repeats else "")


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time (UTC), level, event where it is a notable one, message, and the event's values."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
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
