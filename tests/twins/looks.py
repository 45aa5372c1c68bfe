"""Plain versions of joint sums and of the selection of view sets."""

from itertools import combinations

import numpy as np

from wheretolook.looks.selection import ViewSet, score_of_set


def joint_sums(views, rows):
    """`Detections.joint_sums`, landmark by landmark."""
    sums = np.zeros(16)
    for landmark, terms in enumerate(views.terms):
        missed = 1.0
        for row in rows:
            missed *= 1.0 - float(views.p_detect[row, landmark])
        sums += (1 - missed) * terms
    return sums


def best_of_all_sets(views, set_score, n, rotations):
    """The best of all sets of n views, which `select_views` approximates."""
    sets = []
    for rows in combinations(range(len(views)), n):
        total, order = rotations.shortest(rows)
        sets.append(ViewSet(order, score_of_set(views, set_score, list(rows)), total))
    return max(sets, key=lambda one: one.score)
