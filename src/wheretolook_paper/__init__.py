"""Studies and reproduction of the paper: figures, tables, release, baselines, learners that do not ship."""
