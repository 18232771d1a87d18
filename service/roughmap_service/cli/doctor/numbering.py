"""Which messages were lost on the way: publishers number theirs in an 8-byte attachment."""

MAX_ROWS = 16
"""Publishers of one key that are told apart."""

MAX_STEP = 1_000
"""A number further ahead than this is another publisher's, or that of one that was restarted."""


class Numbers:
    """The numbers of one key's messages. Two publishers may share a key, each with a counter of its own.

    ``lost`` is the number of messages that are missing between those that came.
    """

    def __init__(self) -> None:
        self._rows: dict[str, list[int]] = {}
        self.lost = 0

    def add(self, number: int, source: str = "") -> None:
        """Take the next message's number; ``source`` names its publisher, if Zenoh does."""
        if source not in self._rows and len(self._rows) >= MAX_ROWS:
            return
        rows = self._rows.setdefault(source, [])
        ahead = [(number - last, at) for at, last in enumerate(rows) if 0 < number - last <= MAX_STEP]
        if ahead:
            step, at = min(ahead)
            rows[at] = number
            self.lost += step - 1
        elif len(rows) < MAX_ROWS:
            rows.append(number)
