"""Tables of the paper and of sets of views."""
