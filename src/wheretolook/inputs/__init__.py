"""What a method may look at: the localization map, binned landmarks, single landmarks in view."""
