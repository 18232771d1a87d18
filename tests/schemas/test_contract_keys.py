"""Key expressions: made and taken apart, as the contract has them and as a configuration renames them."""

import pytest
from contract_tools import int32s, many, names
from hypothesis import given
from hypothesis import strategies as st

from roughmap_schemas import ConfigFault, Keys, MessageFault, QueryFault, Refusal
from roughmap_schemas.keys import INGEST, TEMPLATES, canonical_number

KEYS = Keys("site")
INPUTS = ("points", "odometry", "transform", "ingest_points", "ingest_odometry", "ingest_transform")
CUSTOM = {
    "points": "fleet/{robot}/{map}/scan",
    "tiles": "t/{x}/{y}/level/{z}",
    "updates": "{z}/changed/{y}/{x}",
    "alive": "{instance}/of/{map}",
    "ingest_points": "in/{robot}",
    "control": "do/{action}/now",
    "status": "health",
}


def test_the_keys_of_the_contract() -> None:
    assert KEYS.points("r1") == "robots/r1/points"
    assert KEYS.odometry("r1") == "robots/r1/odometry"
    assert KEYS.transform("r1") == "robots/r1/transform"
    assert TEMPLATES["trajectory"] == "robots/{robot}/trajectory"
    assert KEYS.ingest_points("r1") == "maps/site/ingest/r1/points"
    assert KEYS.ingest_odometry("r1") == "maps/site/ingest/r1/odometry"
    assert KEYS.ingest_transform("r1") == "maps/site/ingest/r1/transform"
    assert KEYS.tile(2, -3, 40) == "maps/site/tiles/2/-3/40"
    assert KEYS.update(2, -3, 40) == "maps/site/updates/2/-3/40"
    assert (KEYS.region, KEYS.cells) == ("maps/site/region", "maps/site/cells")
    assert (KEYS.events, KEYS.status) == ("maps/site/events", "maps/site/status")
    assert (KEYS.control("snapshot"), KEYS.control("reset")) == (
        "maps/site/control/snapshot",
        "maps/site/control/reset",
    )
    assert KEYS.alive("0" * 32) == "maps/site/alive/" + "0" * 32
    assert (KEYS.updates_topic, KEYS.queries) == ("maps/site/updates", "maps/site/queries")


def test_the_expressions_over_all() -> None:
    assert (KEYS.points_any, KEYS.odometry_any) == ("robots/*/points", "robots/*/odometry")
    assert (KEYS.transform_any, KEYS.alive_any) == ("robots/*/transform", "maps/site/alive/*")
    assert KEYS.ingest_any == ["maps/site/ingest/**"]
    assert (KEYS.tiles_any, KEYS.updates_any) == ("maps/site/tiles/*/*/*", "maps/site/updates/*/*/*")
    assert (KEYS.tiles(), KEYS.tiles(0), KEYS.tiles(0, -1)) == (
        "maps/site/tiles/*/*/*",
        "maps/site/tiles/0/*/*",
        "maps/site/tiles/0/-1/*",
    )


@pytest.mark.parametrize(
    ("templates", "expected"),
    [
        ({f"ingest_{kind}": f"in/{{map}}/{kind}/{{robot}}" for kind in INGEST}, ["in/site/**"]),
        ({"ingest_points": "in/{robot}"}, ["in/*", "maps/site/ingest/*/odometry", "maps/site/ingest/*/transform"]),
        (
            {f"ingest_{kind}": f"maps/{{map}}/{{robot}}/{kind}" for kind in INGEST},  # tiles lie beside them
            [f"maps/site/*/{kind}" for kind in INGEST],
        ),
        (
            {f"ingest_{kind}": f"in/{kind}/{{robot}}" for kind in INGEST} | {"points": "{robot}/points"},
            [f"in/{kind}/*" for kind in INGEST],
        ),
    ],
)
def test_the_expressions_over_ingest_keys_take_in_no_others(templates: dict[str, str], expected: list[str]) -> None:
    assert Keys("site", templates).ingest_any == expected


def robot_of(keys: Keys, name: str, key: str) -> str:
    """The robot in a key of that name."""
    if not name.startswith("ingest_"):
        return str(getattr(keys, f"parse_{name}")(key))
    kind, robot = keys.parse_ingest(key)
    if f"ingest_{kind}" != name:
        raise MessageFault(Refusal.BAD_KEY, f"it is of {kind}")
    return robot


@many
@given(names, names, st.sampled_from([None, CUSTOM]))
def test_robots_there_and_back(map_name: str, robot: str, templates: dict[str, str] | None) -> None:
    keys = Keys(map_name, templates)
    for name in INPUTS:
        assert robot_of(keys, name, getattr(keys, name)(robot)) == robot


@many
@given(names, st.integers(0, 23), int32s, int32s, st.sampled_from([None, CUSTOM]))
def test_tiles_there_and_back(map_name: str, z: int, x: int, y: int, templates: dict[str, str] | None) -> None:
    keys = Keys(map_name, templates)
    assert keys.parse_tile_selector(keys.tile(z, x, y), 24) == (z, x, y)
    for selected in ((None, x, y), (z, None, y), (z, x, None), (None, None, None)):
        assert keys.parse_tile_selector(keys.tiles(*selected), 24) == selected


@many
@given(names, names, st.sampled_from(INPUTS), st.sampled_from(INPUTS))
def test_a_key_is_of_one_form(map_name: str, robot: str, made: str, read: str) -> None:
    keys = Keys(map_name)
    if made != read:
        with pytest.raises(MessageFault) as caught:
            robot_of(keys, read, getattr(keys, made)(robot))
        assert caught.value.code == "bad_key"


@pytest.mark.parametrize("robot", ["", "*", "**", "a b", "a/b", "r$*", "é", "r" * 65, "r\n", "{robot}", "r:1"])
def test_robots_that_cannot_be(robot: str) -> None:
    for name in INPUTS:
        with pytest.raises(MessageFault) as caught:
            robot_of(KEYS, name, getattr(KEYS, name)(robot))
        assert caught.value.code == "bad_key"
        assert "wildcard" in caught.value.message
        assert "1 to 64 of the letters" in caught.value.message


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "m" * 65, "é", "site\n", "{map}"])
def test_maps_that_cannot_be(name: str) -> None:
    with pytest.raises(ConfigFault, match=r"map\.name"):
        Keys(name)


@pytest.mark.parametrize(
    "key",
    [
        "maps/site/tiles/0/1",
        "maps/site/tiles/0/1/2/3",
        "maps/other/tiles/0/1/2",
        "maps/site/tile/0/1/2",
        "maps/site/tiles/0/+1/2",
        "maps/site/tiles/0/01/2",
        "maps/site/tiles/0/-0/2",
        "maps/site/tiles/0/1/-02",
        "maps/site/tiles/00/1/2",
        "maps/site/tiles/0/1/2147483648",
        "maps/site/tiles/0/-2147483649/2",
        "maps/site/tiles/0/1/",
        "maps/site/tiles/0/1/2.0",
        "maps/site/tiles/0/1/1e3",
        "maps/site/tiles/0/1/ 2",
        "maps/site/tiles/0/1/٣",
        "maps/site/tiles/0/1/-",
        "maps/site/tiles/0/1/2$*",
        "",
    ],
)
def test_tile_keys_that_cannot_be(key: str) -> None:
    with pytest.raises(QueryFault) as caught:
        KEYS.parse_tile_selector(key)
    assert caught.value.code == "bad_key"


@pytest.mark.parametrize("level", ["8", "-1", "100"])
def test_levels_that_the_map_has_not(level: str) -> None:
    with pytest.raises(QueryFault) as caught:
        KEYS.parse_tile_selector(f"maps/site/tiles/{level}/0/0", 8)
    assert caught.value.code == "bad_level"
    assert "0 to 7" in caught.value.message


@many
@given(st.integers(-(2**33), 2**33), st.sampled_from(["", "+", "0", "-0", " "]))
def test_numbers_are_canonical(value: int, before: str) -> None:
    text = f"{before}{value}"
    expected = value if text == str(value) and -(2**31) <= value < 2**31 else None
    assert canonical_number(text) == expected


@pytest.mark.parametrize(
    ("name", "template", "words"),
    [
        ("points", "robots/points", "{robot} once"),
        ("points", "robots/{robot}/{robot}", "{robot} once"),
        ("points", "robots/{robot}/{z}", "{robot} once"),
        ("points", "robots/r{robot}/points", "not a key"),
        ("points", "robots/*/{robot}", "not a key"),
        ("points", "/robots/{robot}", "not a key"),
        ("points", "robots//{robot}", "not a key"),
        ("points", "robots/{robot}/", "not a key"),
        ("points", "robots/{robot}/a?b", "not a key"),
        ("tiles", "tiles/{z}/{x}", "{x}, {y}, {z} once"),
        ("status", "maps/{map}/{robot}", "no placeholder"),
        ("status", "{map}/{map}", "no placeholder"),
        ("nothing", "a/b", "unknown"),
    ],
)
def test_templates_that_cannot_be(name: str, template: str, words: str) -> None:
    with pytest.raises(ConfigFault) as caught:
        Keys("site", {name: template})
    assert f"keys.{name}" in str(caught.value)
    assert words in str(caught.value)
