"""Fisher information of viewpoints (Zhang and Scaramuzza 2020), exact and as a field: the baseline of the paper."""
