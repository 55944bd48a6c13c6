"""The trackers: what makes a pose out of what the cameras saw."""
