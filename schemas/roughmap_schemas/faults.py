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
    """Something that came from outside breaks the contract.

    ``code`` is the word that goes on the wire, ``message`` one line that says what was expected and what was found.
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
    """A message is refused before it is logged; ``code`` is a ``Refusal``."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(Refusal(code), message)


class QueryFault(Fault):
    """A query is answered with an error; ``code`` is a ``QueryCode``."""

    exit_code = 2

    def __init__(self, code: str, message: str) -> None:
        super().__init__(QueryCode(code), message)


class ConfigFault(ContractError):
    """A setting can't be used; one line that names the source, the key and what is allowed."""

    exit_code = 2


class UnknownEventKind(ContractError):
    """An event of a kind that this version doesn't know: a reader stops there, since it can't tell what it changed."""

    kind: str

    def __init__(self, kind: str) -> None:
        super().__init__(f"unknown kind of event: {kind!r}")
        self.kind = kind


def bad_message(message: str) -> MessageFault:
    """Make the fault for a payload that can't be used."""
    return MessageFault(Refusal.BAD_MESSAGE, message)


def too_large(message: str) -> MessageFault:
    """Make the fault for a payload that passes a limit."""
    return MessageFault(Refusal.TOO_LARGE, message)
