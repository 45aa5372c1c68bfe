"""Names of the attributes of a map's landmarks. Not in `landmarks.py`, so that options are read without PyTorch."""

MAP_ATTRIBUTES = (
    "track_length",  # logarithm of the number of observations
    "reprojection_error",  # mean error in pixels
    "triangulation_angle",  # logarithm of the largest angle between two rays, in degrees
    "direction_spread",  # 1 - |mean mapping direction|
    "ambiguity",  # cosine between the landmark's descriptor and the nearest one of another landmark
    "mapped_distance",  # logarithm of the mean mapping distance, in metres
    "distance_spread",  # standard deviation of the mapping distances over their mean
    "mapped_pixel_size",  # logarithm of the mean mapping distance over the mapping cameras' focal length in pixels
)
"""Attributes of a landmark that scorers use; NaN where a value is unknown."""
