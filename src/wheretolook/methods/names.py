"""Names of methods that several parts of the package ask for."""

from __future__ import annotations

Method = tuple[str, str]
"""Name of a method and its input variant ("" if it has none)."""


ORACLE: Method = ("oracle", "")
"""The method that knows the labels."""


LEARNED = "mlp"
"""The paper's network: `LearnedScorer.name`, without loading PyTorch."""


PROBABILITIES = (LEARNED, "trees", "conv", "set", "sphere")
"""Methods whose scores are probabilities, learnt from labels."""


BEST: Method = ("set", "")
"""The method that others are compared with unless told otherwise: the best there is."""
