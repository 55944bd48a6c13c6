"""The experiments of Kehl & Van Gool 2006, section 7, and the accuracy for the views of its table 1."""
