"""Which landmarks a viewpoint sees: not occluded (a matter of the location alone) and inside the camera's view."""
