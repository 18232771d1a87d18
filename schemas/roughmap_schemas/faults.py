"""The base of all errors, and the errors of the contract: what was sent was wrong, and how."""

from typing import ClassVar

from roughmap_schemas.reasons import QueryCode, Refusal


class ReportedError(Exception):
    """An error with a known cause. Its text is one line that names the cause; a command prints it and exits.

    ``exit_code`` is 2 where the command line, a setting or an input file must be changed, else 1.
    """

    exit_code: ClassVar[int] = 1


class ContractError(ReportedError):
    """The base of the errors that this package raises."""


class Fault(ContractError):
    """Something received breaks the contract.

    ``code`` is the code of the error reply; ``message`` is one line that says what was expected and what was found.
    """

    code: str
    message: str

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = str(code)
        self.message = message

    def __reduce__(self) -> tuple[type["Fault"], tuple[str, str]]:
        return type(self), (self.code, self.message)


class MessageFault(Fault):
    """A message that must be refused; ``code`` is a ``Refusal``."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(Refusal(code), message)


class QueryFault(Fault):
    """A query that must be answered with an error; ``code`` is a ``QueryCode``."""

    exit_code = 2

    def __init__(self, code: str, message: str) -> None:
        super().__init__(QueryCode(code), message)


class ConfigFault(ContractError):
    """An invalid setting; one line that names its source, its key and what is allowed."""

    exit_code = 2


class UnknownEventKind(ContractError):
    """An event of an unknown kind. A reader that rebuilds the map must stop there: it cannot know what changed."""

    kind: str

    def __init__(self, kind: str) -> None:
        super().__init__(f"unknown kind of event: {kind!r}; read this log with a newer release of roughmap")
        self.kind = kind


def bad_message(message: str) -> MessageFault:
    """Return the fault for an unusable payload."""
    return MessageFault(Refusal.BAD_MESSAGE, message)


def too_large(message: str) -> MessageFault:
    """Return the fault for a payload over a limit."""
    return MessageFault(Refusal.TOO_LARGE, message)
