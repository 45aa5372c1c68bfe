"""Labels without annotators: render a viewpoint, localize the image against the map, measure the pose error."""
