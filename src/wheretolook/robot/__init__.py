"""The default scorer on a robot, without PyTorch: what is exported, and the one file that runs there."""
