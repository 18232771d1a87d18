"""The token that the pages want to be shown."""

from pathlib import Path

from roughmap_schemas.faults import ReportedError
from roughmap_schemas.sections import HttpConfig


class HttpError(ReportedError):
    """The pages can't be served as configured; one line that names what to change."""

    exit_code = 2


def token_of(http: HttpConfig) -> bytes | None:
    """The token that must be shown, from the environment or its file; None if there is none. HttpError."""
    if http.token is not None:
        return http.token.get_secret_value().encode()
    if http.token_file is None:
        return None
    try:
        token = Path(http.token_file).read_bytes().strip()
    except OSError as error:
        raise HttpError(f"http.token_file: {http.token_file}: {error.strerror}") from None
    if not token:
        raise HttpError(f"http.token_file: {http.token_file}: is empty; write a token of your own into it")
    return token
