"""Waypoints are read from every usual format, and invalid files are rejected."""

import numpy as np
import pytest

from wheretolook.select.waypoints import Waypoints, parse_points, read_waypoints
from wheretolook.utils.errors import TableError

AT = [[1.5, -2.0, 0.25], [0.0, 3.0, 1.0]]


@pytest.mark.parametrize(
    ("text", "ids", "lines"),
    [
        ("x,y,z\n1.5,-2,0.25\n0,3,1\n", ("0", "1"), (2, 3)),
        ("\ufeffid,X,Y,Z,comment\na,1.5,-2,0.25,first\nb,0,3,1,\n", ("a", "b"), (2, 3)),
        ("1.5, -2, .25\n\n0, 3, 1\n", ("0", "1"), (1, 3)),
        ("z;y;x\n0.25;-2;1.5\n1;3;0\n", ("0", "1"), (2, 3)),
        ("1,5;-2;0,25\n0;3;1\n", ("0", "1"), (1, 2)),
        ("# id x y z\n10 1.5 -2 0.25\n2 0 3 1\n", ("10", "2"), (2, 3)),
        ("1.5 -2 0.25\n0 3 1\n", ("0", "1"), (1, 2)),
        (
            "# timestamp tx ty tz qx qy qz qw\n17.25 1.5 -2 0.25 0 0 0 1\n17.5 0 3 1 0 0 0 1\n",
            ("17.25", "17.5"),
            (2, 3),
        ),
    ],
    ids=["csv", "csv-with-id", "csv-without-header", "semicolons", "decimal-commas", "benchmark", "plain", "tum"],
)
def test_formats(text, ids, lines, tmp_path):
    path = tmp_path / "waypoints"
    path.write_text(text, encoding="utf-8")
    found = read_waypoints(path)
    np.testing.assert_array_equal(found.points, AT)
    assert (found.ids, found.lines, found.path) == (ids, lines, path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# x y z\n\n",
        "x,y,z\n",
        "x,y\n1,2\n",
        "1,2,3\n4,5\n",
        "1 2 3\n4 five 6\n",
        "1 2 3 4 5\n",
        "x,y,z\n1,2,3\n1,nan,3\n",
        "1 2 inf\n",
        "id,x,y,z\nw1,1,2,-0,5,1,2\n",  # decimal commas
        "x,x,y,z\n1,1,2,3\n",
        'id,x,y,z\n"a\nb",1,2,3\n',
    ],
)
def test_invalid_files_are_rejected(text, tmp_path):
    path = tmp_path / "waypoints.csv"
    path.write_text(text)
    with pytest.raises(TableError):
        read_waypoints(path)


def test_a_zero_quaternion_is_no_heading(tmp_path):
    path = tmp_path / "path.tum"
    path.write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 0\n")
    assert read_waypoints(path).points.tolist() == [[1, 2, 3]] * 2
    with pytest.raises(TableError, match=r"needs the heading.*line 2"):
        read_waypoints(path).heading_deg(np.eye(3))


def test_points_from_text_and_arrays():
    np.testing.assert_array_equal(parse_points(["1.5,-2,.25", " 0,3,1"]).points, AT)
    assert Waypoints.of([1, 2, 3]).points.shape == (1, 3)
    assert Waypoints.of(AT, ("a", "b"))[np.array([False, True])].ids == ("b",)
    for text in ("1,2", "a,b,c", "1,2,nan"):
        with pytest.raises(TableError):
            parse_points([text])
    for invalid in ([np.zeros((0, 3))], [np.zeros((2, 2))], ["abc"], [[[1, 2], [3]]], [AT, ("a",)]):
        with pytest.raises(TableError):
            Waypoints.of(*invalid)
