"""CRC-32 of two strings of bytes, one after the other, from the checksums of each: bytes are summed once."""

from functools import lru_cache

POLYNOMIAL = 0xEDB88320
"""Of CRC-32, as in zlib: bit 31 is the coefficient of x^0."""

ONE = 1 << 31


def combined(first: int, second: int, length: int) -> int:
    """Return the checksum of two strings, of their checksums and the ``length`` of the second in bytes."""
    return _times(_power(length), first) ^ second


def _times(a: int, b: int) -> int:
    """Return a b modulo the polynomial."""
    product = 0
    while a:
        if a & ONE:
            product ^= b
        a = (a << 1) & 0xFFFFFFFF
        b = b >> 1 ^ POLYNOMIAL if b & 1 else b >> 1
    return product


@lru_cache
def _doubled(k: int) -> int:
    """Return x^(8 * 2^k) modulo the polynomial."""
    return _times(_doubled(k - 1), _doubled(k - 1)) if k else ONE >> 8


@lru_cache
def _power(length: int) -> int:
    """Return x^(8 length) modulo the polynomial: how the sum of what comes before changes by ``length`` bytes."""
    power, k = ONE, 0
    while length:
        if length & 1:
            power = _times(_doubled(k), power)
        length, k = length >> 1, k + 1
    return power
