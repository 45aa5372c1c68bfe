"""Names of what a map knows of its landmarks: apart from `Landmarks`, so that options can be read without PyTorch."""

MAP_ATTRIBUTES = (
    "track_length", "reprojection_error", "triangulation_angle", "direction_spread", "ambiguity", "mapped_distance",
    "distance_spread",
)  # fmt: skip
"""What a scorer is told of a landmark in its map: the logarithm of the number of observations; the mean error in
pixels; the logarithm of the largest angle between two rays, in degrees; 1 - |mean mapping direction|; the cosine
between its descriptor and the nearest other one; the logarithm of the mean mapping distance, in metres; the standard
deviation of the mapping distances over their mean. NaN where one is not known."""
