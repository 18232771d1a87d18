"""The token that requests must show."""

from pathlib import Path

from roughmap_schemas.faults import ReportedError
from roughmap_schemas.sections import HttpConfig


class HttpError(ReportedError):
    """The pages can't be served as configured. The message is one line and names what to change."""

    exit_code = 2


def token_of(http: HttpConfig) -> bytes | None:
    """Return the token from the environment or its file, None if there is none; raise HttpError."""
    if http.token is not None:
        return http.token.get_secret_value().encode()
    if http.token_file is None:
        return None
    try:
        token = Path(http.token_file).read_bytes().strip()
    except OSError as error:
        raise HttpError(f"http.token_file: {http.token_file}: {error.strerror}") from None
    if not token:
        raise HttpError(f"http.token_file: {http.token_file} is empty; write a token into it")
    return token
