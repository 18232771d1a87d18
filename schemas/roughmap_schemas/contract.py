"""The version of the contract between a service and its clients. Its rules are in ``schemas/README.md``."""

from typing import Final

CONTRACT_VERSION: Final = "1.0"
"""``major.minor``: a minor release only adds, a major one may break. Every JSON reply carries it as ``contract``."""


def major(version: str) -> str:
    """Return the part before the dot: versions that share it understand each other."""
    return version.partition(".")[0]


def is_compatible(version: str) -> bool:
    """Return whether a client of this release understands replies in that version of the contract."""
    return major(version) == major(CONTRACT_VERSION)
