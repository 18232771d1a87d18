"""What can go wrong for a planner, as one tree."""

from roughmap_schemas.faults import ReportedError

__all__ = [
    "BadArgument",
    "ContractMismatch",
    "IncompleteAnswer",
    "MixedInstances",
    "NoAnswer",
    "QueryRefused",
    "RoughMapError",
    "UnreadableAnswer",
    "in_short",
]


class RoughMapError(ReportedError):
    """Base of everything that the client raises of its own accord."""


class BadArgument(RoughMapError, ValueError):
    """What the caller gave can't be asked of any service: a name that is none, points that are not (N, 2)."""


class NoAnswer(RoughMapError):
    """Nothing came within the time limit: no service of that name is reachable, or it is too busy, or access is denied
    (a denial by access control is silent)."""


class QueryRefused(RoughMapError):
    """The service answered with an error.

    `code` is one of the contract's (`bad_bbox`, `too_large`, `busy`, ...), `message` says what was wrong.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


class IncompleteAnswer(RoughMapError):
    """Parts of an answer are missing, or are of different states of the map: the link broke or the time ran out in
    between. Nothing of it is handed on; ask again."""


class MixedInstances(RoughMapError):
    """Two services answer on the same keys. Their maps differ, so nothing of the answer is handed on."""


class UnreadableAnswer(RoughMapError):
    """An answer is not in the contract's form: another program, or a service of another release, answers here."""


class ContractMismatch(RoughMapError):
    """The service and this client speak different major versions of the contract. Upgrade the older of the two."""


def in_short(error: Exception) -> str:
    """What Zenoh says of a failure, without where in its own sources it arose (" at /.../file.rs:12")."""
    return str(error).split("\n", 1)[0].split(" at /", 1)[0][:200]
