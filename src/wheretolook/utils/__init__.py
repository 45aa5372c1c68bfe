"""What every part needs and none owns: errors, files, processes, Warp, tracking."""
