"""Inputs made from the corpus by Hypothesis: bytes changed, cut out, doubled, and joined with others."""

from collections.abc import Callable

from hypothesis import strategies as st
from targets import corpus_of


@st.composite
def mutated(draw: st.DrawFn, target: str) -> bytes:
    seeds = [path.read_bytes() for path in corpus_of(target)]
    payload = bytearray(draw(st.sampled_from(seeds)))
    steps: list[Callable[[], None]] = []

    def place() -> int:
        return draw(st.integers(0, len(payload)))

    def change() -> None:
        at = place()
        payload[at : at + 1] = bytes([draw(st.integers(0, 255))])

    def replace() -> None:
        a, b = sorted((place(), place()))
        payload[a:b] = draw(st.binary(max_size=12))

    def copy() -> None:
        a, b, at = place(), place(), place()
        payload[at:at] = payload[min(a, b) : max(a, b)][:4096]

    def join() -> None:
        other = draw(st.sampled_from(seeds))
        payload[place() :] = other[draw(st.integers(0, len(other))) :]

    steps = [change, replace, copy, join]
    for step in draw(st.lists(st.sampled_from(steps), min_size=1, max_size=5)):
        step()
    return bytes(payload)
