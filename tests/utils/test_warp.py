"""How Warp's kernels are compiled."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import warp as wp

import wheretolook

PACKAGE = Path(wheretolook.__file__).parent
FILES = sorted(file for file in PACKAGE.rglob("*.py") if "@wp.kernel" in file.read_text())


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_kernel_is_compiled_for_gradients(file: Path) -> None:
    """Nothing here asks for gradients of a kernel, and their code takes as long to compile as the kernel."""
    name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
    import_module(name)
    module = wp.get_module(name)
    assert module.kernels
    for kernel in module.kernels.values():
        assert kernel.options.get("enable_backward", module.options["enable_backward"]) is False, kernel.key
