"""What follows from a sequence of poses."""
