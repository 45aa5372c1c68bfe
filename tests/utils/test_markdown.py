"""Numbers of things are singular for one."""

from wheretolook.utils.texts import counted


def test_counted():
    assert [counted(n, "view") for n in (0, 0.8, 1, 2.2, 1260)] == [
        "0 views",
        "1 view",
        "1 view",
        "2 views",
        "1,260 views",
    ]
