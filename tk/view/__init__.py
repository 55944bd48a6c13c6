"""A result in a window of Open3D: `tk view`."""
