"""How far a result is from ground truth, and how well it fits the images."""
