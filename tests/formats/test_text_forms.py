"""Text files as programs really write them: read to the right points, or refused with the line and a remedy."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_service.formats import text
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.recorded import CloudFileFault


def read(file: Path) -> list[list[float]]:
    return [row for part in read_cloud(file) for row in part.points.tolist()]


POINTS = [[1.25, 2.5, 0.75], [-1.35, 2.5, 0.8]]


@pytest.mark.parametrize(
    "content",
    [
        "1,25;2,50;0,75\n-1,35;2,50;0,8\n",
        "x;y;z\n1,25;2,50;0,75\n-1,35;2,50;0,8\n",
        "1,25 2,50 0,75\n-1,35 2,50 0,8\n",
        "1,25\t2,50\t0,75\n-1,35\t2,50\t0,8\n",
        "1,25;2,50;0,75;tree\n-1,35;2,50;0,8;rock no. 2\n",
        "\ufeffx,y,z\n1.25,2.50,0.75\n-1.35,2.50,0.8\n",
        "Easting,Northing,Elevation\n1.25,2.50,0.75\n-1.35,2.50,0.8\n",
        "id;Height [m];N;E\n1;0.75;2.50;1.25\n2;0.8;2.50;-1.35\n",
        "n,k,x,y,z,c\n0,0,1.25,2.5,0.75,0\n1,1,-1.35,2.5,0.8,0\n",
        ",x,y,z\n0,1.25,2.5,0.75\n1,-1.35,2.5,0.8\n",
        "x,y,z,lat,lon\n1.25,2.5,0.75,9,9\n-1.35,2.5,0.8,9,9\n",
        '"x","y","z","label"\n"1.25","2.5","0.75","a, b"\n"-1.35","2.5","0.8","c"\n',
        "# intensity x y z\n9 1.25 2.5 0.75\n8 -1.35 2.5 0.8\n",
        "//X Y Z R\n1.25 2.5 0.75 7\n-1.35 2.5 0.8 7\n",
        "2\n1.25 2.5 0.75 -100 10 10 10\n-1.35 2.5 0.8 -5 1 1 1\n",
        "1\n1.25 2.5 0.75\n1\n-1.35 2.5 0.8\n",
        "x y z\n1.25 2.5 0.75\nx y z\n-1.35 2.5 0.8\n",
        "1.25, 2.5, 0.75\n-1.35, 2.5, 0.8\n",
        "\n1.25 2.5 .75 # a\n\n-1.35 25e-1 0.8 // b\n\n",
        "1.25\t2.5\t0.75\t\n-1.35\t2.5\t0.8\t\n",
        "1.25 2.5 0.75\r\n-1.35 2.5 0.8\r\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_read_to_the_same_points(tmp_path: Path, content: str, encoding: str) -> None:
    file = tmp_path / "points.csv"
    file.write_bytes(content.encode(encoding))
    assert read(file) == POINTS


@pytest.mark.parametrize("word", ["nan", "NaN", "-nan(ind)", "1.#QNAN", "null", "N/A", "#N/A", "", "inf"])
def test_no_number_is_not_finite(tmp_path: Path, word: str) -> None:
    file = tmp_path / "points.csv"
    file.write_text(f"1,2,{word}\n2,{word},3\n2,2,3\n")
    first, second, third = read(file)
    assert first[:2] == [1, 2]
    assert not math.isfinite(first[2])
    assert not math.isfinite(second[1])
    assert third == [2, 2, 3]


@pytest.mark.parametrize(
    ("content", "line", "said"),
    [
        ("ncols 3\nnrows 2\n55.2 55.3 55.4\n", 1, "ESRI ASCII grid"),
        ("NROWS 2\nNCOLS 3\n55.2 55.3 55.4\n", 1, "gdal_translate"),
        ("2\n3\n0 0 0\n1 0 0\n", 1, "PTX"),
        ("3\n1 2 3\n4 5 6\n", 1, "a count of 3 points, but 2 follow"),
        ("1\n1 2 3\n2\n4 5 6\n", 3, "a count of 2 points, but 1 follow"),
        ("lon,lat,h\n-93.35,41.57,16\n", 1, "degrees"),
        ("a,b,c\n1,2,3\n", 1, "expected a header with one column x \\(or Easting\\), found 'a, b, c'"),
        ("x,y,height,elevation\n1,2,3,4\n", 1, "one column z"),
        ("x [mm],y [mm],z [mm]\n1,2,3\n", 1, "not in metres"),
        ("x,y,z\n", 1, "no points"),
        ("x,y,z\n401,25,5700,50,0,75\n", 2, "decimal commas.*semicolons"),
        ("401,25,5700,50,0,75\n402,35,5700,50,0,80\n", 1, "decimal marks as well as separators"),
        ("401,25,5700,5,0,75\n402,35,5700,5,0,8\n", 1, "name them in a first line"),
        ("401,25 5700,50\n", 1, "separate all columns by the same sign"),
        ("1,2,3 128 64\n", 1, "separate all columns by the same sign"),
        ("1,234;5,678;9,012\n", 1, "decimal marks or thousands"),
        ("1,234 5,678 9,012\n", 1, "decimal marks or thousands"),
        ("1 2 3.5\n1 2,5 3\n", 2, "decimal commas and points are mixed"),
        ("1.5 2 3\n" * 2000 + "1 2,5 3\n", 2001, "has a decimal comma"),
        ("1,5 2 3\n" * 2000 + "1 2.5 3\n", 2001, "has a decimal point where"),
        ("1,5;2;3\n1.234;2;3\n", 2, "decimal commas and points are mixed"),
        ('"401,25","5700,50","0,75"\n', 1, "decimal comma"),
        ("2'683'141.25 1'247'945.50 408.75\n", 1, "thousands"),
        ("2 683 141.25 1 247 945.50 408.75\n", 1, "thousands"),
        ("2\u00a0683\u00a0141,25 1\u00a0247\u00a0945,50 408,75\n", 1, "thousands"),
        ("2.683.141,25;1.247.945,50;408,75\n", 1, "thousands"),
        ("2,683,141.25 1,247,945.50 408.75\n", 1, "thousands"),
        ("2,683,141.25,1,247,945.50,408.75\n", 1, "thousands"),
        ("1 2 3\n2 2 3\nTotal 2 points written\n", 3, "'Total' is not a number.*put # before it"),
        ("1 2 3\n\n# a\n2 2\n", 4, "2 columns, but 3 in line 1"),
        ("x,y,z,i\n1,2,3,4\n1,2,5,3,4\n", 3, "5 columns, but 4 in line 2"),
        ("1 2 3\n1 2 3 4\n", 2, "4 columns, but 3 in line 1"),
        ("1 2\n", 1, "expected three numbers"),
        ("1 2 0x10\n", 1, "'0x10' is not a number"),
        ("1 2 1_0\n", 1, "thousands"),
        ("1 2 3\n\0\0\0\n", 2, "binary"),
        ("1 2 3\n" + "1 " * 40_000 + "\n", 2, "longer than"),
        ("9" * 5000 + "\n1 2 3\n", 1, "expected three numbers"),
    ],
)
def test_refused_in_one_line(tmp_path: Path, content: str, line: int, said: str) -> None:
    file = tmp_path / "points.txt"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(CloudFileFault, match=said) as caught:
        read(file)
    message = str(caught.value)
    assert message.startswith(f"{file}, line {line}: ")
    assert "\n" not in message


coordinates = st.tuples(*[st.decimals(-9_999_999, 9_999_999, allow_nan=False, places=p) for p in (2, 3, 4)])


@given(rows=st.lists(coordinates, min_size=1, max_size=30), separator=st.sampled_from([";", "\t", " ", "   "]))
@examples(60)
def test_commas_and_points_are_the_same(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[object, ...]], separator: str
) -> None:
    folder = tmp_path_factory.mktemp("forms")
    pointed = "".join(separator.join(f"{value:f}" for value in row) + "\n" for row in rows)  # type: ignore[str-format]
    (folder / "a.xyz").write_text(pointed)
    (folder / "b.xyz").write_text(pointed.replace(".", ","))
    expected = [[float(value) for value in row] for row in rows]  # type: ignore[arg-type]
    assert read(folder / "a.xyz") == read(folder / "b.xyz") == expected


SEPARATORS = {" ": "x y z", ",": "x,y,z", ";": "x;y;z", "\t": "x\ty\tz"}


@given(
    count=st.integers(1, 400),
    bad=st.integers(0, 10_000),
    word=st.sampled_from(["x1.5", "1.2.3", "--1", "1,5,6", "abc", "1e", "0x1"]),
    column=st.integers(0, 2),
    separator=st.sampled_from(sorted(SEPARATORS)),
    extra=st.integers(0, 2),
    header=st.booleans(),
    remarks=st.sets(st.integers(0, 399), max_size=10),
)
@examples(120)
def test_a_bad_line_is_named(
    tmp_path_factory: pytest.TempPathFactory,
    count: int,
    bad: int,
    word: str,
    column: int,
    separator: str,
    extra: int,
    header: bool,
    remarks: set[int],
) -> None:
    """The number is the file's, whatever comes before and however the file is cut into blocks."""
    bad = 1 + bad % count  # the first line is good: it shows the form
    lines = [SEPARATORS[separator] + "".join(f"{separator}c{k}" for k in range(extra))] if header else []
    expected = 0
    for k in range(count + 1):
        if k in remarks:
            lines += ["# a remark, with commas", ""]
        fields = [f"{k}.25", f"{-k}.5", "1.0", *["7"] * extra]
        if k == bad:
            fields[column] = word
            expected = len(lines) + 1
        lines.append(separator.join(fields))
    file = tmp_path_factory.mktemp("bad") / "points.xyz"
    file.write_text("\n".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "BLOCK", 997)
        with pytest.raises(CloudFileFault) as caught:
            read(file)
    assert str(caught.value).startswith(f"{file}, line {expected}: ")


@given(
    rows=st.lists(st.tuples(*[st.floats(-1e7, 1e7)] * 3), min_size=1, max_size=50),
    order=st.permutations(["x", "y", "z", "intensity"]),
    block=st.integers(200, 1000),
)
@examples(60)
def test_columns_in_any_order_and_blocks_of_any_size(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]], order: list[str], block: int
) -> None:
    file = tmp_path_factory.mktemp("order") / "points.csv"
    named = [{"x": repr(x), "y": repr(y), "z": repr(z), "intensity": "7"} for x, y, z in rows]
    file.write_text("\n".join([",".join(order), *(",".join(row[name] for name in order) for row in named)]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "BLOCK", block)
        assert np.array_equal(read(file), rows)


def test_six_whole_numbers_are_read_under_their_names(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("x,y,z,r,g,b\n1,2,3,128,128,128\n")
    assert read(file) == [[1, 2, 3]]
