"""The Active Localization Benchmark (of ActLoc, 2025): its folders in, the whole round out. `wheretolook benchmark`."""
