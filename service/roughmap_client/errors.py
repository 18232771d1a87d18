"""The errors of the client: one tree under `RoughMapError`."""

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
    "short_message",
]


class RoughMapError(ReportedError):
    """The base of all errors of the client."""


class BadArgument(RoughMapError, ValueError):
    """An invalid argument, such as a bad name or points that are not (N, 2); nothing was sent."""


class NoAnswer(RoughMapError):
    """No answer within the time limit: the service is not reachable or too busy, or access control denies the query,
    which it does silently."""


class QueryRefused(RoughMapError):
    """The service answered with an error.

    `code` is one of the contract's (`bad_bbox`, `too_large`, `busy`, ...); `message` says what was expected and found.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


class IncompleteAnswer(RoughMapError):
    """Replies of an answer are missing, or show different states of the map, because the link broke or time ran out.
    None of them are returned; ask again."""


class MixedInstances(RoughMapError):
    """Two services answer on the same keys. Their maps differ, so none of their replies are returned."""


class UnreadableAnswer(RoughMapError):
    """An answer is not in the contract's form: some other program answers on these keys."""


class ContractMismatch(RoughMapError):
    """The service and this client speak different major versions of the contract. Upgrade the older of the two."""


def short_message(error: Exception) -> str:
    """Return Zenoh's message of an error without the place in Zenoh's sources (" at /.../file.rs:12")."""
    return str(error).split("\n", 1)[0].split(" at /", 1)[0][:200]
