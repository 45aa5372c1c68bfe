"""Folders of temporary files: gone at the end, whenever Ctrl-C comes."""

import shutil
from pathlib import Path

import pytest

from wheretolook.utils.files import temporary_folder


def test_the_folder_is_its_owners_alone_and_goes_with_all_that_is_in_it(tmp_path):
    with temporary_folder(".partial", parent=tmp_path) as folder:
        assert folder.parent == tmp_path and folder.name.endswith(".partial")
        assert folder.stat().st_mode & 0o777 == 0o700
        (folder / "inside").mkdir()
        (folder / "inside" / "file").write_text("something")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_none_while_it_is_made(tmp_path, monkeypatch):
    make = Path.mkdir

    def interrupted(path, *options, **named):
        make(path, *options, **named)
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", interrupted)
    with pytest.raises(KeyboardInterrupt), temporary_folder(parent=tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_none_while_it_is_removed(tmp_path, monkeypatch):
    remove = shutil.rmtree
    calls = []

    def interrupted(path, **named):
        calls.append(path)
        if len(calls) == 1:
            raise KeyboardInterrupt
        remove(path, **named)

    monkeypatch.setattr(shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt), temporary_folder(parent=tmp_path) as folder:
        (folder / "file").write_text("something")
    assert list(tmp_path.iterdir()) == []
