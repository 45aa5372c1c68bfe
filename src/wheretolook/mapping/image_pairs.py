"""Reads hloc's files of image pairs: the mapping images that retrieval found for each query."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from wheretolook.mapping.colmap_model import ModelArrays, observation_matrix
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import path_ends
from wheretolook.utils.reading import read_text

MAX_BYTES = 2**28


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """The mapping images paired with each query, and the landmarks that they observe."""

    path: Path
    images: dict[str, list[int]]  # rows of mapping images in the model, by the query's name in the file
    observed: csr_array  # (I, N) which landmarks they observe

    @classmethod
    def read(cls, path: Path, model: ModelArrays, landmark_ids: NDArray[np.int64]) -> ImagePairs:
        """Read a file with lines "query mapping_image", given a model and the ids (N,) of its landmarks, ascending.

        Raises TableError if a line is not two names, or no image of the model is named.
        """
        images: dict[str, list[int]] = defaultdict(list)
        row_of = {name: row for row, name in enumerate(model.image_names)}
        try:
            lines = read_text(path, MAX_BYTES).splitlines()
        except (OSError, ValueError) as error:
            raise TableError(f"the pairs of images cannot be read: {error}", path=path) from error
        for number, line in enumerate(lines, 1):
            names = line.split()
            if len(names) not in (0, 2):
                fix = "Give hloc's file of pairs: a query and a mapping image in each line."
                raise TableError(f"line {number} is not a pair of images", path=path, value=line[:80], fix=fix)
            if names:
                images[names[0]] += [row_of[name] for name in names[1:] if name in row_of]
        if not any(images.values()):
            fix = f"Its images have names such as {model.image_names[0]}." if model.image_names else ""
            raise TableError("no mapping image of the pairs is in the model", path=path, fix=fix)
        points = np.intersect1d(model.point_ids, landmark_ids, return_indices=True)[1]
        return cls(path, images, observation_matrix(model)[:, points])

    def landmarks(self, query: str) -> NDArray[np.int64]:
        """Return the rows of the landmarks of a query, by its path or the end of it. Raises TableError if it has none."""
        names = path_ends(PurePath(query))
        found = next((self.images[name] for name in names if name in self.images), None)
        if found is None:
            ends = [rows for name, rows in self.images.items() if PurePath(name).name == names[-1]]
            if len(ends) != 1:
                fix = "Name it in the first column."
                raise TableError("the pairs do not name this image", path=self.path, value=query, fix=fix)
            found = ends[0]
        return np.unique(self.observed[found].indices).astype(np.int64)
