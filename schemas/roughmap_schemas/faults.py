"""The errors of the contract: what was sent was wrong, and how."""

from roughmap_schemas.reasons import QueryCode, Refusal


class ContractError(Exception):
    """The base of every error that this package raises on purpose."""


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

    def __init__(self, code: str, message: str) -> None:
        super().__init__(QueryCode(code), message)


class ConfigFault(ContractError):
    """A setting can't be used; one line that names the source, the key and what is allowed."""


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
