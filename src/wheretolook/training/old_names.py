"""How methods were named before each had one name, so that older tables, weights and runs are read as new ones.

Tables had two columns, `method` and `inputs` ("fisher" and "trace gp", "mlp" and "2d+z"); records of training had a
`variant` ("2d+z", "released", "set"), and only the paper's network had variants that were no names of methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


def name_of(method: str, inputs: str = "") -> str:
    """The name of a method from the two columns of an older table."""
    return "-".join(filter(None, [method, inputs.replace(" ", "-")]))


def name_of_variant(variant: str) -> str:
    """The name of a method from the `variant` of an older record, run or table."""
    return f"mlp-{variant}" if variant.startswith("2d") or variant == "released" else variant


def with_names(table: pd.DataFrame) -> pd.DataFrame:
    """A table with a column `method` alone in place of `method` and `inputs`, or of `variant`."""
    if "inputs" in table:
        inputs = table["inputs"].fillna("")
        names = [name_of(*pair) for pair in zip(table["method"], inputs, strict=True)]
        table = table.assign(method=names).drop(columns="inputs")
        if "reference" in table:
            words = table["reference"].fillna("").str.partition(" ")
            table["reference"] = [name_of(*pair) for pair in zip(words[0], words[2], strict=True)]
    elif "variant" in table and "method" not in table:
        table = table.assign(variant=table["variant"].map(name_of_variant)).rename(columns={"variant": "method"})
    return table


def with_name(about: Mapping[str, Any]) -> dict[str, Any]:
    """What a record tells of a training, with the name of the method, and its options beside those that all share."""
    if "variant" not in about:
        return dict(about)
    variant = about["variant"]
    config = dict(about.get("config", {}))
    named = {"method" if key == "variant" else key: value for key, value in about.items()}
    named["method"] = name_of_variant(variant)
    own = config.pop(variant, {})
    return named | ({"config": {**own, **config}} if "config" in about else {})


def name_of_header(header: Mapping[str, Any]) -> str:
    """The name of the method that weights serve, from the description in their header."""
    if "method" in header or "kind" in header:
        return str(header.get("method", header.get("kind")))
    training = header.get("training", {})
    return str(training.get("method") or name_of_variant(training.get("variant") or header.get("variant", "")))
