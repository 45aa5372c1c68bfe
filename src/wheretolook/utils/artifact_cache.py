"""Results stored in a folder together with the key of their inputs, so that a later run reuses or replaces them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.utils.files import atomic_write, read_json, read_json_object, write_json

if TYPE_CHECKING:
    import pandas as pd


def cache_key(*parts: Any) -> str:
    """Hash the inputs of a computation to 16 hexadecimal digits; values that JSON lacks are hashed by their text."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class ArtifactCache:
    """Results of one step of work, valid while `key`, which `cache_key` computes from the inputs, stays the same.

    The manifest, a JSON file in the folder, maps each finished step to its key. With `steps` in their order of work,
    storing or clearing one invalidates the later ones. An unreadable manifest or result counts as missing.

    Results are tables (`.parquet`), named arrays (`.npz`) or JSON values (`.json`), by the ending of their names:

        cache = ArtifactCache(folder, cache_key(settings, fingerprint(path)))
        results = cache.load("views.parquet")
        if results is None:
            results = cache.store({"views.parquet": compute()})
    """

    def __init__(
        self, folder: Path, key: str = "", step: str = "key", manifest: str = "manifest.json", steps: Sequence[str] = ()
    ) -> None:
        self.folder = folder
        self.key = key
        self.step = step
        self.manifest = folder / manifest
        self.steps = steps

    @property
    def stored_key(self) -> str | None:
        """The key that the step was finished with; None if it was not."""
        return self._keys().get(self.step)

    def is_current(self, *files: Path) -> bool:
        """Return whether the step was finished with this key and the files still exist."""
        return self.stored_key == self.key and all(file.exists() for file in files)

    def load(self, *names: str) -> dict[str, Any] | None:
        """Read the named results; None if they are of another key, missing or unreadable."""
        if not self.is_current():
            return None
        try:
            return {name: _read(self.folder / name) for name in names}
        except (OSError, ValueError):
            return None

    def store(self, results: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Write named results, then the key; without results, files that the caller wrote. Returns the results."""
        if results:
            self.clear()  # so that no key describes files of different runs
        for name, value in (results or {}).items():
            _write(self.folder / name, value)
        write_json(self.manifest, {**self._valid(self._keys()), self.step: self.key})
        return dict(results or {})

    def clear(self) -> None:
        """Remove the key of this step and of later ones; files stay."""
        keys = self._keys()
        valid = self._valid(keys)
        if valid != keys:
            write_json(self.manifest, valid)

    def _keys(self) -> dict[str, str]:
        try:
            return read_json_object(self.manifest)
        except (OSError, ValueError):
            return {}

    def _valid(self, keys: dict[str, str]) -> dict[str, str]:
        """The keys that do not depend on this step."""
        outdated = self.steps[self.steps.index(self.step) :] if self.steps else [self.step]
        return {step: key for step, key in keys.items() if step not in outdated}


def _read(path: Path) -> Any:
    if path.suffix == ".json":
        return read_json(path)
    if path.suffix == ".npz":
        from wheretolook.utils.npz_files import load_npz

        return load_npz(path)
    from wheretolook.utils.parquet_files import read_parquet

    return read_parquet(path)


def _write(path: Path, value: Any) -> None:
    if path.suffix == ".json":
        write_json(path, value)
    elif path.suffix == ".npz":
        from wheretolook.utils.npz_files import save_npz

        save_npz(path, value)
    else:
        table: pd.DataFrame = value
        with atomic_write(path) as partial:
            table.to_parquet(partial, index=False, write_page_checksum=True)
