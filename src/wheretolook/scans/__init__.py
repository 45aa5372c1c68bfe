"""RGB-D recordings: read, checked, fused to a coloured mesh."""
