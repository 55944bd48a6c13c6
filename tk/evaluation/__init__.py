"""Distances of a result from ground truth, and its fit to the images."""
