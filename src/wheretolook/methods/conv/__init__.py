"""A convolutional network over the bins."""
